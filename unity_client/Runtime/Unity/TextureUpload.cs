// Textures on the graphics card, with the colour space that the scene states.
using IrisSession.Core;
using UnityEngine;

namespace IrisSession.Unity
{
    /// <summary>Makes textures.</summary>
    public static class TextureUpload
    {
        /// <summary>Sharpness of what is seen at a grazing angle, as of a table top.</summary>
        private const int Anisotropy = 4;

        /// <summary>Return the texture of a picture, null when the engine cannot read it.</summary>
        /// <param name="isSrgb">The graphics card makes its values linear as it reads them; it needs a project in linear colour space.</param>
        /// <param name="isCube">Six faces one below another: smaller copies would mix them, and so would an edge that repeats.</param>
        public static Texture2D Make(TextureImage image, bool isSrgb, bool isCube)
        {
            Texture2D texture = new Texture2D(image.Width, image.Height, TextureFormat.RGBA32, !isCube, !isSrgb);
            if (image.Encoded != null)
            {
                if (!texture.LoadImage(image.Encoded, true))
                {
                    Object.Destroy(texture);
                    return null;
                }
            }
            else
            {
                texture.SetPixelData(image.Pixels, 0, 0);
                texture.Apply(!isCube, true);
            }
            texture.wrapMode = isCube ? TextureWrapMode.Clamp : TextureWrapMode.Repeat;
            texture.filterMode = isCube ? FilterMode.Bilinear : FilterMode.Trilinear;
            texture.anisoLevel = isCube ? 1 : Anisotropy;
            return texture;
        }
    }
}
