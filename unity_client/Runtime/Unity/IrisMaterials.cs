// Materials of everything that is drawn: copies of those of the package, one for each look. Their shaders are in Shaders/.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using UnityEngine;

namespace IrisSession.Unity
{
    /// <summary>The materials of the package, as references: shaders that only code names are left out of a build.</summary>
    [Serializable]
    public sealed class IrisMaterials
    {
        /// <summary>`IrisSurface.mat`, with instancing.</summary>
        public Material Surface;

        /// <summary>`IrisPoints.mat`.</summary>
        public Material Points;

        public bool AreSet { get { return Surface != null && Points != null; } }
    }

    /// <summary>Names that the shaders know.</summary>
    public static class ShaderNames
    {
        public static readonly int BaseColor = Shader.PropertyToID("_BaseColor");
        public static readonly int BaseMap = Shader.PropertyToID("_BaseMap");

        /// <summary>0: no texture, 1: by coordinates, 2: cube, its six faces one below another.</summary>
        public static readonly int Mapping = Shader.PropertyToID("_Mapping");

        /// <summary>Colour of highlights, and their exponent.</summary>
        public static readonly int Highlight = Shader.PropertyToID("_Highlight");

        /// <summary>Share of its own colour that a surface shines with, whatever the lights are.</summary>
        public static readonly int Emission = Shader.PropertyToID("_Emission");
        public static readonly int SourceBlend = Shader.PropertyToID("_SrcBlend");
        public static readonly int TargetBlend = Shader.PropertyToID("_DstBlend");
        public static readonly int DepthWrite = Shader.PropertyToID("_ZWrite");
        public static readonly int Cull = Shader.PropertyToID("_Cull");
        public static readonly int Dimmed = Shader.PropertyToID("_IrisDimmed");
        public static readonly int LightCount = Shader.PropertyToID("_IrisLightCount");
        public static readonly int LightPositions = Shader.PropertyToID("_IrisLightPositions");
        public static readonly int LightDirections = Shader.PropertyToID("_IrisLightDirections");
        public static readonly int LightAmbient = Shader.PropertyToID("_IrisLightAmbient");
        public static readonly int LightDiffuse = Shader.PropertyToID("_IrisLightDiffuse");
        public static readonly int LightSpecular = Shader.PropertyToID("_IrisLightSpecular");
        public static readonly int LightAttenuation = Shader.PropertyToID("_IrisLightAttenuation");
        public static readonly int HeadlightAmbient = Shader.PropertyToID("_IrisHeadlightAmbient");
        public static readonly int HeadlightDiffuse = Shader.PropertyToID("_IrisHeadlightDiffuse");
        public static readonly int HeadlightSpecular = Shader.PropertyToID("_IrisHeadlightSpecular");
        public static readonly int Points = Shader.PropertyToID("_IrisPoints");
        public static readonly int LatticeToWorld = Shader.PropertyToID("_IrisLatticeToWorld");
        public static readonly int PointSize = Shader.PropertyToID("_IrisPointSize");
    }

    /// <summary>Makes materials of looks, each once.</summary>
    public sealed class MaterialCache
    {
        // Values of UnityEngine.Rendering.BlendMode and CullMode, as properties of a material have them.
        private const float One = 1f;
        private const float Zero = 0f;
        private const float SourceAlpha = 5f;
        private const float OneMinusSourceAlpha = 10f;
        private const float CullNone = 0f;
        private const float CullBack = 2f;
        private const int OpaqueQueue = 2000;
        private const int TransparentQueue = 3000;

        /// <summary>OpenGL's exponent of the sharpest highlight.</summary>
        private const float MaxExponent = 128f;

        private readonly IrisMaterials templates;
        private readonly List<Material> made = new List<Material>();

        public MaterialCache(IrisMaterials templates)
        {
            this.templates = templates;
        }

        public Material Points { get { return templates.Points; } }

        /// <summary>Return the material of a part or deformable. `texture`: null while it is not here.</summary>
        public Material Make(SceneSurface surface, Texture2D texture, bool isDoubleSided)
        {
            Material material = Make(UnityValues.ToVector4(surface.Rgba), surface.IsTransparent, isDoubleSided);
            material.SetVector(ShaderNames.Highlight, new Vector4(surface.Highlight.X, surface.Highlight.Y, surface.Highlight.Z, surface.Shininess * MaxExponent));
            material.SetFloat(ShaderNames.Emission, surface.Emission);
            SetTexture(material, surface.Mapping, texture);
            return material;
        }

        /// <summary>Return a plain material.</summary>
        public Material Make(Vector4 color, bool isTransparent, bool isDoubleSided)
        {
            Material material = new Material(templates.Surface);
            made.Add(material);
            material.SetVector(ShaderNames.BaseColor, color);
            material.SetFloat(ShaderNames.Mapping, 0f);
            material.SetFloat(ShaderNames.Emission, 0f);
            material.SetVector(ShaderNames.Highlight, new Vector4(0f, 0f, 0f, 1f));
            material.SetFloat(ShaderNames.SourceBlend, isTransparent ? SourceAlpha : One);
            material.SetFloat(ShaderNames.TargetBlend, isTransparent ? OneMinusSourceAlpha : Zero);
            material.SetFloat(ShaderNames.DepthWrite, isTransparent ? 0f : 1f);
            material.SetFloat(ShaderNames.Cull, isDoubleSided ? CullNone : CullBack);
            material.renderQueue = isTransparent ? TransparentQueue : OpaqueQueue;
            material.enableInstancing = true;
            return material;
        }

        /// <summary>Give a material its texture when it has come.</summary>
        public static void SetTexture(Material material, TextureMapping mapping, Texture2D texture)
        {
            material.SetFloat(ShaderNames.Mapping, texture == null ? 0f : (float)mapping);
            if (texture != null) material.SetTexture(ShaderNames.BaseMap, texture);
        }

        /// <summary>Destroy a material of this cache.</summary>
        public void Release(Material material)
        {
            if (made.Remove(material)) UnityEngine.Object.Destroy(material);
        }
    }
}
