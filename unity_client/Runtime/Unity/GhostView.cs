// A ghost of a robot's hand at its target, before the arm moves there.
using IrisSession.Core;
using IrisSession.Protocol;
using UnityEngine;
using UnityEngine.Rendering;
using Material = UnityEngine.Material;

namespace IrisSession.Unity
{
    /// <summary>One ghost. Hidden until <see cref="Show"/>.</summary>
    public sealed class GhostView
    {
        private const float Alpha = 0.35f;
        private readonly SceneView scene;
        private readonly MaterialCache materials;
        private GhostShape shape;
        private ScenePlan plan;
        private string robot = "";
        private GameObject[] pieces = new GameObject[0];
        private MeshFilter[] filters = new MeshFilter[0];
        private Material material;

        public GhostView(SceneView scene, MaterialCache materials)
        {
            this.scene = scene;
            this.materials = materials;
        }

        public bool IsShown { get; private set; }

        /// <summary>Show the hand of a robot with its site at a pose in the world, in a colour 0xRRGGBB. Once a frame.</summary>
        public void Show(RobotInfo info, RigidTransform T_world_target, int color)
        {
            if (scene.Plan == null) return;
            if (scene.Plan != plan || info.Name != robot) Make(info);
            if (!IsShown) SetActive(true);
            material.SetVector(ShaderNames.BaseColor, UnityValues.ToVector4(color, Alpha));
            for (int i = 0; i < pieces.Length; i++)
            {
                GhostPiece piece = shape.Pieces[i];
                if (filters[i].sharedMesh == null) filters[i].sharedMesh = scene.FindMesh(piece.Part);
                UnityValues.Place(pieces[i].transform, shape.PlacePiece(piece, scene.Bodies.Poses, T_world_target));
            }
        }

        public void Hide()
        {
            if (IsShown) SetActive(false);
        }

        public void Destroy()
        {
            foreach (GameObject one in pieces) Object.Destroy(one);
            pieces = new GameObject[0];
            plan = null;
            IsShown = false;
            if (!(material is null)) materials.Release(material);
            material = null;
        }

        private void Make(RobotInfo info)
        {
            Destroy();
            plan = scene.Plan;
            robot = info.Name;
            shape = new GhostShape(plan, info);
            material = materials.Make(UnityValues.ToVector4(0xffffff, Alpha), true, false);
            material.SetFloat(ShaderNames.Emission, 1f);
            pieces = new GameObject[shape.Pieces.Count];
            filters = new MeshFilter[pieces.Length];
            for (int i = 0; i < pieces.Length; i++)
            {
                pieces[i] = new GameObject("ghost of " + robot);
                pieces[i].transform.SetParent(scene.Bodies.Root, false);
                filters[i] = pieces[i].AddComponent<MeshFilter>();
                MeshRenderer renderer = pieces[i].AddComponent<MeshRenderer>();
                renderer.sharedMaterial = material;
                renderer.shadowCastingMode = ShadowCastingMode.Off;
                renderer.receiveShadows = false;
            }
            IsShown = true;
        }

        private void SetActive(bool isActive)
        {
            IsShown = isActive;
            foreach (GameObject one in pieces) one.SetActive(isActive);
        }
    }
}
