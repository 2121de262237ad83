// Pictures of textures as Unity's `Texture2D` takes them: red, green, blue, alpha, the lowest row first.
using System;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>One picture. That of a cube has its six faces one below another.</summary>
    public sealed class TextureImage
    {
        /// <summary>Largest side that graphics cards of headsets take.</summary>
        public const int MaxSide = 16_384;

        public readonly int Width;
        public readonly int Height;

        /// <summary>Four bytes for each pixel; null when `Encoded` is to be decoded by the engine.</summary>
        public readonly byte[] Pixels;

        /// <summary>Bytes of a PNG or JPEG file; else null.</summary>
        public readonly byte[] Encoded;

        private TextureImage(int width, int height, byte[] pixels, byte[] encoded)
        {
            Width = width;
            Height = height;
            Pixels = pixels;
            Encoded = encoded;
        }

        /// <summary>Read an asset.</summary>
        /// <exception cref="DecodeException">It is no picture.</exception>
        public static TextureImage Read(TextureLevel level, byte[] bytes, ArrayDecoder decoder)
        {
            if (level.Encoding == AssetEncoding.Png || level.Encoding == AssetEncoding.Jpeg)
            {
                if (level.Width > MaxSide || level.Height > MaxSide) throw new DecodeException("a picture of " + level.Width + " x " + level.Height + " pixels");
                return new TextureImage((int)level.Width, (int)level.Height, null, bytes);
            }
            if (level.Encoding != AssetEncoding.Arrays) throw new DecodeException("a picture in an unknown encoding, " + level.Encoding);
            ArrayAsset asset = decoder.Decode(bytes);
            if (asset.Kind != ArrayKind.Image) throw new DecodeException("an asset of another kind where a picture is needed");
            byte[] rows = asset.RequireBytes(ArrayName.Pixels, ArrayAsset.Any, ArrayAsset.Any, ArrayAsset.Any);
            int[] shape = asset.Find(ArrayName.Pixels).Shape;
            return FromRows(shape[1], shape[0], shape[2], rows);
        }

        /// <summary>Return the picture of rows from above, with 1, 3 or 4 channels.</summary>
        /// <exception cref="DecodeException">It has another number, or no graphics card takes it.</exception>
        public static TextureImage FromRows(int width, int height, int channels, byte[] rows)
        {
            bool isKnown = (channels == 1 || channels == 3 || channels == 4) && width > 0 && height > 0 && width <= MaxSide && height <= MaxSide;
            if (!isKnown) throw new DecodeException("a picture of " + width + " x " + height + " pixels with " + channels + " channels");
            byte[] pixels = new byte[4 * width * height];
            for (int row = 0; row < height; row++)
            {
                int from = channels * width * (height - 1 - row);
                for (int to = 4 * width * row, end = to + 4 * width; to < end; to += 4, from += channels)
                {
                    pixels[to] = rows[from];
                    pixels[to + 1] = rows[channels == 1 ? from : from + 1];
                    pixels[to + 2] = rows[channels == 1 ? from : from + 2];
                    pixels[to + 3] = channels == 4 ? rows[from + 3] : (byte)255;
                }
            }
            return new TextureImage(width, height, pixels, null);
        }
    }
}
