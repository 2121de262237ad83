// Panels and rays as texts and lines in the room. What they say and where they are is decided elsewhere.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Interaction;
using UnityEngine;

namespace IrisSession.Unity.Input
{
    /// <summary>Draws panels below one transform, the tracking frame. One draw call for each that says something, one for each ray.</summary>
    public sealed class PanelViews
    {
        /// <summary>Size at which the font is rasterised: a line of 3 cm at arm's length has some 40 pixels.</summary>
        private const int FontSize = 48;

        /// <summary>Height of a line of TextMesh in the engine: a tenth of font size times character size, by its manual's units.</summary>
        private const float LinePerSize = 0.1f;
        private const float RayWidth = 0.003f;

        // By PanelStyle.
        private static readonly Color[] Colors =
        {
            new Color(0.88f, 0.64f, 0.23f, 1), new Color(0.79f, 0.82f, 0.88f, 1), new Color(0.88f, 0.64f, 0.23f, 1), new Color(0.79f, 0.82f, 0.88f, 1),
            new Color(0.88f, 0.64f, 0.23f, 1), new Color(0.79f, 0.82f, 0.88f, 1), new Color(0.21f, 0.82f, 0.73f, 1), new Color(0.85f, 0.21f, 0.24f, 1),
        };

        private static readonly Color RayColor = new Color(0.79f, 0.82f, 0.88f, 0.7f);
        private static readonly Color HitColor = new Color(0.21f, 0.82f, 0.73f, 1);
        private readonly IPanels panels;
        private readonly TextMesh[] texts;
        private readonly string[] shown;
        private readonly LineRenderer[] rays;

        /// <param name="parent">The tracking frame.</param>
        /// <param name="rayMaterial">Unlit, null: no rays are drawn.</param>
        public PanelViews(IPanels panels, Transform parent, Material rayMaterial)
        {
            this.panels = panels;
            texts = new TextMesh[panels.All.Count];
            shown = new string[texts.Length];
            for (int i = 0; i < texts.Length; i++) texts[i] = MakeText(parent, panels.All[i]);
            rays = new LineRenderer[panels.Rays.Length];
            for (int i = 0; i < rays.Length && rayMaterial != null; i++) rays[i] = MakeRay(parent, rayMaterial);
        }

        /// <summary>Draw the panels of a frame for a head at `p_tracking_head`.</summary>
        public void Update(Double3 p_tracking_head)
        {
            IReadOnlyList<Panel> all = panels.All;
            for (int i = 0; i < texts.Length; i++)
            {
                Panel panel = all[i];
                GameObject one = texts[i].gameObject;
                if (one.activeSelf != panel.IsShown) one.SetActive(panel.IsShown);
                if (!panel.IsShown) continue;
                if (shown[i] != panel.Text) texts[i].text = shown[i] = panel.Text;
                texts[i].color = Colors[(int)panel.Style];
                texts[i].characterSize = (float)panel.LineM / (LinePerSize * FontSize);
                one.transform.SetLocalPositionAndRotation(EnginePoses.ToEngine(panel.At), EnginePoses.ToEngine(HeadsetPanels.Face(panel.At, p_tracking_head)));
            }
            for (int i = 0; i < rays.Length; i++) UpdateRay(rays[i], panels.Rays[i]);
        }

        /// <summary>Remove all of it: what it says is not true any more.</summary>
        public void Destroy()
        {
            foreach (TextMesh text in texts) if (text != null) Object.Destroy(text.gameObject);
            foreach (LineRenderer ray in rays) if (ray != null) Object.Destroy(ray.gameObject);
        }

        private static void UpdateRay(LineRenderer line, PanelRay ray)
        {
            if (line == null) return;
            line.enabled = ray.LengthM > 0;
            if (!line.enabled) return;
            line.SetPosition(0, EnginePoses.ToEngine(ray.Ray.Origin));
            line.SetPosition(1, EnginePoses.ToEngine(ray.Ray.Origin + ray.LengthM * ray.Ray.Direction));
            line.startColor = line.endColor = ray.IsHit ? HitColor : RayColor;
        }

        private static TextMesh MakeText(Transform parent, Panel panel)
        {
            GameObject one = new GameObject("iris-session panel " + panel.Style);
            one.transform.SetParent(parent, false);
            TextMesh text = one.AddComponent<TextMesh>();
            text.font = Resources.GetBuiltinResource<Font>("LegacyRuntime.ttf"); // in every player; a text made by code may have none
            one.GetComponent<Renderer>().sharedMaterial = text.font.material;
            text.richText = false; // names of others are in it
            text.fontSize = FontSize;
            text.anchor = TextAnchor.LowerCenter;
            text.alignment = TextAlignment.Center;
            one.SetActive(false);
            return text;
        }

        private static LineRenderer MakeRay(Transform parent, Material material)
        {
            GameObject one = new GameObject("iris-session ray");
            one.transform.SetParent(parent, false);
            LineRenderer line = one.AddComponent<LineRenderer>();
            line.sharedMaterial = material;
            line.useWorldSpace = false;
            line.positionCount = 2;
            line.startWidth = line.endWidth = RayWidth;
            return line;
        }
    }
}
