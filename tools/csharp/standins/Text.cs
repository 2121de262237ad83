// Texts and lines in the room.
using Standins;

namespace UnityEngine
{
    public struct Color
    {
        public float r;
        public float g;
        public float b;
        public float a;

        public Color(float r, float g, float b, float a)
        {
            this.r = r;
            this.g = g;
            this.b = b;
            this.a = a;
        }
    }

    public enum TextAnchor
    {
        LowerCenter = 7,
    }

    public enum TextAlignment
    {
        Left = 0,
        Center = 1,
        Right = 2,
    }

    public sealed class Font : Object
    {
        internal static readonly Font Builtin = new Font();

        public Material material { get; set; } = new Material(new Shader("GUI/Text Shader"));
    }

    public sealed class Resources
    {
        public static T GetBuiltinResource<T>(string path) where T : Object { return path == "LegacyRuntime.ttf" ? Font.Builtin as T : null; }
    }

    [RequireComponent(typeof(MeshRenderer))]
    public sealed class TextMesh : Component
    {
        public Font font { get; set; }

        public string text { get; set; } = "";

        public bool richText { get; set; } = true;

        public int fontSize { get; set; }

        public float characterSize { get; set; } = 1f;

        public TextAnchor anchor { get; set; }

        public TextAlignment alignment { get; set; }

        public Color color { get; set; }
    }

    public sealed class LineRenderer : Renderer
    {
        private Vector3[] points = new Vector3[0];

        public bool useWorldSpace { get; set; } = true;

        public float startWidth { get; set; } = 1f;

        public float endWidth { get; set; } = 1f;

        public Color startColor { get; set; }

        public Color endColor { get; set; }

        public int positionCount
        {
            get { return points.Length; }
            set
            {
                Engine.CheckThread();
                System.Array.Resize(ref points, value);
            }
        }

        public void SetPosition(int index, Vector3 position) { points[index] = position; }

        public Vector3 GetPosition(int index) { return points[index]; }
    }
}
