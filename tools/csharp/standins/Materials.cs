// Shaders, materials and textures of the engine: names and values, nothing is shaded.
using System;
using System.Collections.Generic;
using Standins;

namespace UnityEngine
{
    public sealed class Shader : Object
    {
        private static readonly Dictionary<string, int> Ids = new Dictionary<string, int>();
        private static Properties globals = new Properties();

        /// <summary>Stands for a shader of the package that tests make materials with.</summary>
        internal Shader(string name)
        {
            this.name = name;
        }

        public static int PropertyToID(string name)
        {
            lock (Ids)
            {
                if (!Ids.TryGetValue(name, out int id)) Ids[name] = id = Ids.Count + 1;
                return id;
            }
        }

        public static void SetGlobalFloat(int nameID, float value) { globals.Set(nameID, value); }

        public static float GetGlobalFloat(int nameID) { return globals.GetFloat(nameID); }

        public static void SetGlobalVectorArray(int nameID, Vector4[] values) { globals.Set(nameID, values); }

        public static Vector4[] GetGlobalVectorArray(int nameID) { return globals.GetVectors(nameID); }

        public static void SetGlobalVector(int nameID, Vector4 value) { globals.Set(nameID, value); }

        public static Vector4 GetGlobalVector(int nameID) { return globals.GetVector(nameID); }

        internal static void ResetGlobals() { globals = new Properties(); }
    }

    /// <summary>Values by property id. Setting a known one allocates nothing.</summary>
    internal sealed class Properties
    {
        private readonly Dictionary<int, float> floats = new Dictionary<int, float>();
        private readonly Dictionary<int, Vector4> vectors = new Dictionary<int, Vector4>();
        private readonly Dictionary<int, Vector4[]> arrays = new Dictionary<int, Vector4[]>();
        private readonly Dictionary<int, object> objects = new Dictionary<int, object>();

        public Properties()
        {
        }

        public Properties(Properties other)
        {
            floats = new Dictionary<int, float>(other.floats);
            vectors = new Dictionary<int, Vector4>(other.vectors);
            objects = new Dictionary<int, object>(other.objects);
        }

        public void Set(int id, float value) { Engine.CheckThread(); floats[id] = value; }

        public void Set(int id, Vector4 value) { Engine.CheckThread(); vectors[id] = value; }

        public void Set(int id, object value) { Engine.CheckThread(); objects[id] = value; }

        /// <summary>Its length is that of the first time, as in the engine.</summary>
        public void Set(int id, Vector4[] values)
        {
            Engine.CheckThread();
            if (!arrays.TryGetValue(id, out Vector4[] kept)) arrays[id] = kept = new Vector4[values.Length];
            Array.Copy(values, kept, Math.Min(values.Length, kept.Length));
        }

        public float GetFloat(int id) { return floats.TryGetValue(id, out float value) ? value : 0f; }

        public Vector4 GetVector(int id) { return vectors.TryGetValue(id, out Vector4 value) ? value : default; }

        public Vector4[] GetVectors(int id) { return arrays.TryGetValue(id, out Vector4[] values) ? (Vector4[])values.Clone() : null; }

        public object GetObject(int id) { return objects.TryGetValue(id, out object value) ? value : null; }
    }

    public class Material : Object
    {
        internal readonly Properties Properties;

        public Material(Shader shader)
        {
            Engine.CheckThread();
            this.shader = shader;
            Properties = new Properties();
        }

        public Material(Material source)
        {
            Engine.CheckThread();
            shader = source.shader;
            enableInstancing = source.enableInstancing;
            renderQueue = source.renderQueue;
            Properties = new Properties(source.Properties);
        }

        public Shader shader { get; set; }

        public int renderQueue { get; set; } = 2000;

        public bool enableInstancing { get; set; }

        public void SetFloat(int nameID, float value) { Properties.Set(nameID, value); }

        public void SetVector(int nameID, Vector4 value) { Properties.Set(nameID, value); }

        public void SetTexture(int nameID, Texture value) { Properties.Set(nameID, (object)value); }

        public float GetFloat(int nameID) { return Properties.GetFloat(nameID); }

        public Vector4 GetVector(int nameID) { return Properties.GetVector(nameID); }

        public Texture GetTexture(int nameID) { return (Texture)Properties.GetObject(nameID); }
    }

    public sealed class MaterialPropertyBlock
    {
        internal readonly Properties Properties = new Properties();

        public void SetFloat(int nameID, float value) { Properties.Set(nameID, value); }

        public void SetMatrix(int nameID, Matrix4x4 value) { Matrices[nameID] = value; }

        public void SetBuffer(int nameID, GraphicsBuffer value) { Properties.Set(nameID, (object)value); }

        internal readonly Dictionary<int, Matrix4x4> Matrices = new Dictionary<int, Matrix4x4>();
    }

    public enum FilterMode
    {
        Point = 0,
        Bilinear = 1,
        Trilinear = 2,
    }

    public enum TextureWrapMode
    {
        Repeat = 0,
        Clamp = 1,
    }

    public enum TextureFormat
    {
        RGB24 = 3,
        RGBA32 = 4,
        R8 = 63,
    }

    public class Texture : Object
    {
        protected Texture()
        {
        }

        public virtual int width { get; set; }

        public virtual int height { get; set; }

        public TextureWrapMode wrapMode { get; set; }

        public FilterMode filterMode { get; set; } = FilterMode.Bilinear;

        public int anisoLevel { get; set; } = 1;

        /// <summary>True when the graphics card makes values linear as it reads them.</summary>
        public bool isDataSRGB { get { return !IsLinear; } }

        internal bool IsLinear { get; private protected set; }
    }

    public sealed class Texture2D : Texture
    {
        private readonly TextureFormat chosen;
        private readonly int pixelBytes;

        public Texture2D(int width, int height, TextureFormat textureFormat, bool mipChain, bool linear)
        {
            Engine.CheckThread();
            if (width <= 0 || height <= 0) throw new ArgumentException("a texture of " + width + " x " + height);
            this.width = width;
            this.height = height;
            chosen = textureFormat;
            pixelBytes = textureFormat == TextureFormat.RGBA32 ? 4 : textureFormat == TextureFormat.RGB24 ? 3 : 1;
            IsLinear = linear;
            Pixels = new byte[width * height * pixelBytes];
            Live++;
        }

        /// <summary>Textures that were made and not destroyed.</summary>
        internal static int Live { get; private set; }

        internal override void Release()
        {
            if (!IsDestroyed) Live--;
            base.Release();
        }

        public TextureFormat format { get { return chosen; } }

        /// <summary>Rows from below, as the engine keeps them.</summary>
        internal byte[] Pixels { get; private set; }

        /// <summary>True after Apply: the graphics card has it.</summary>
        internal bool IsUploaded { get; private set; }

        public void SetPixelData<T>(T[] data, int mipLevel, int sourceDataStartIndex = 0)
        {
            if (typeof(T) != typeof(byte)) throw new NotSupportedException("the layer gives bytes");
            if (mipLevel != 0 || data.Length - sourceDataStartIndex < Pixels.Length) throw new ArgumentException("pixels of another size");
            Buffer.BlockCopy(data, sourceDataStartIndex, Pixels, 0, Pixels.Length);
        }

        public void Apply(bool updateMipmaps, bool makeNoLongerReadable)
        {
            Engine.CheckThread();
            IsUploaded = true;
        }

        internal void Load(int imageWidth, int imageHeight, byte[] pixels)
        {
            width = imageWidth;
            height = imageHeight;
            Pixels = pixels;
            IsUploaded = true;
        }
    }

    public static class ImageConversion
    {
        /// <summary>No decoder of PNG and JPEG here: the size is read of a PNG, its pixels stay black.</summary>
        public static bool LoadImage(this Texture2D tex, byte[] data, bool markNonReadable)
        {
            Engine.CheckThread();
            bool isPng = data.Length > 24 && data[0] == 0x89 && data[1] == 'P' && data[2] == 'N' && data[3] == 'G';
            if (!isPng) return false;
            int width = data[16] << 24 | data[17] << 16 | data[18] << 8 | data[19];
            int height = data[20] << 24 | data[21] << 16 | data[22] << 8 | data[23];
            tex.Load(width, height, new byte[width * height * 4]);
            return true;
        }
    }
}
