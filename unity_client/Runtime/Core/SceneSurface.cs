// How a surface looks by OpenGL's fixed pipeline, as MuJoCo uses it: of the look of a part, or of a deformable.
using System;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Numbers of a shader. The same ones as in web_client/src/view/surface.ts.</summary>
    public sealed class SceneSurface
    {
        /// <summary>Highlights of metals are at least so bright.</summary>
        private const double MetalHighlight = 0.6;

        /// <summary>A texture that shines brighter is white.</summary>
        private const double MaxEmission = 1000.0;

        /// <summary>Red, green, blue, alpha, 0 to 1.</summary>
        public readonly double[] Rgba;

        /// <summary>Colour of highlights.</summary>
        public readonly Float3 Highlight;

        /// <summary>0 to 1; OpenGL's exponent is 128 times that.</summary>
        public readonly float Shininess;
        public readonly float Emission;

        /// <summary>Index in `SceneSpec.Textures`, -1 for none.</summary>
        public readonly int Texture;
        public readonly TextureMapping Mapping;
        public readonly bool IsTransparent;

        private SceneSurface(SceneSpec spec, long index, double[] rgba, int texture, TextureMapping mapping, bool isTransparent)
        {
            Material material = index < 0 ? new Material() : spec.Materials[index];
            double grey = Clamp(material.Specular), metal = Clamp(material.Metallic), bright = Math.Max(grey, MetalHighlight);
            Rgba = new[] { Clamp(rgba[0]), Clamp(rgba[1]), Clamp(rgba[2]), Clamp(rgba[3]) };
            Highlight = new Float3(
                (float)(grey * (1.0 - metal) + bright * metal * Rgba[0]),
                (float)(grey * (1.0 - metal) + bright * metal * Rgba[1]),
                (float)(grey * (1.0 - metal) + bright * metal * Rgba[2]));
            Shininess = (float)Clamp(material.Roughness >= 0.0 ? 1.0 - material.Roughness : material.Shininess);
            Emission = material.Emission > 0.0 ? (float)Math.Min(material.Emission, MaxEmission) : 0f;
            Texture = texture;
            Mapping = mapping;
            IsTransparent = isTransparent;
        }

        public static SceneSurface FromLook(SceneSpec spec, SceneLook look)
        {
            return new SceneSurface(spec, look.Material, look.Rgba, look.Texture, look.Mapping, look.IsTransparent);
        }

        public static SceneSurface FromDeformable(ScenePlan plan, Deformable part)
        {
            int texture = ScenePartBuilder.FindColorTexture(plan.Spec, part.Material);
            bool isDrawn = texture >= 0 && plan.Spec.Textures[texture].Kind == TextureKind.Image && plan.FindTextureLevel(texture) != null;
            bool isTransparent = part.Rgba[3] < 1.0 || (isDrawn && plan.Spec.Textures[texture].Channels == 4);
            return new SceneSurface(plan.Spec, part.Material, part.Rgba, isDrawn ? texture : -1, isDrawn ? TextureMapping.Map : TextureMapping.None, isTransparent);
        }

        /// <summary>Return a value of 0 to 1; 0 for one that is no number.</summary>
        private static double Clamp(double value) { return value > 0.0 ? Math.Min(value, 1.0) : 0.0; }
    }
}
