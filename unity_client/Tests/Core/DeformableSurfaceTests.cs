// Points and normals of cloths, skins and ropes in Unity's axes.
using System;
using System.Linq;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public sealed class DeformableSurfaceTests
    {
        /// <summary>A square of 2 m in the plane z = 1 of the wire, seen from above: x from -1 to 1, y from -1 to 1.</summary>
        private static readonly float[] Square = { -1, -1, 1, 1, -1, 1, 1, 1, 1, -1, 1, 1 };
        private static readonly int[] Elements = { 0, 1, 2, 0, 2, 3 };

        /// <summary>A tetrahedron, counter-clockwise from outside.</summary>
        private static readonly float[] Tetrahedron = { 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1 };
        private static readonly int[] Sides = { 0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3 };

        private static DeformableSurface Build(SheetLook look, float[] vertices, int[] elements, float[] uv = null)
        {
            DeformableSurface surface = DeformableSurface.Make(look, vertices.Length / 3, elements, uv);
            Assert.IsTrue(surface.Build(vertices));
            return surface;
        }

        private static Double3 At(float[] values, int point) { return new Double3(values[3 * point], values[3 * point + 1], values[3 * point + 2]); }

        /// <summary>Fail unless every triangle is clockwise from the side to which its normals point, in left-handed axes.</summary>
        private static void CheckWinding(DeformableSurface surface)
        {
            for (int i = 0; i < surface.Indices.Length; i += 3)
            {
                Double3 a = At(surface.Positions, surface.Indices[i]), b = At(surface.Positions, surface.Indices[i + 1]), c = At(surface.Positions, surface.Indices[i + 2]);
                Double3 normal = At(surface.Normals, surface.Indices[i]) + At(surface.Normals, surface.Indices[i + 1]) + At(surface.Normals, surface.Indices[i + 2]);
                Assert.Greater(Double3.Dot(Double3.Cross(b - a, c - a), normal), 0.0);
            }
        }

        [Test]
        public void AClothHasTwoSidesAndARim()
        {
            DeformableSurface cloth = Build(new SheetLook(2, 0.1, false), Square, Elements);
            CheckWinding(cloth);
            // Up is y. The first four points are the upper side.
            for (int i = 0; i < 4; i++)
            {
                Assert.AreEqual(1.1, cloth.Positions[3 * i + 1], 1e-6);
                Assert.AreEqual(1.0, cloth.Normals[3 * i + 1], 1e-6);
                Assert.AreEqual(0.9, cloth.Positions[3 * (4 + i) + 1], 1e-6);
                Assert.AreEqual(-1.0, cloth.Normals[3 * (4 + i) + 1], 1e-6);
            }
            // Of the rim normals point away from the middle.
            Assert.AreEqual(8 + 4 * 6, cloth.Positions.Length / 3);
            for (int i = 8; i < cloth.Positions.Length / 3; i++)
            {
                Assert.Greater(cloth.Normals[3 * i] * cloth.Positions[3 * i] + cloth.Normals[3 * i + 2] * cloth.Positions[3 * i + 2], 0.9);
            }
            Assert.AreEqual(new Float3(-1f, 0.9f, -1f), cloth.Low);
            Assert.AreEqual(new Float3(1f, 1.1f, 1f), cloth.High);
        }

        [TestCase(false)]
        [TestCase(true)]
        public void ASkinIsSeenFromOutside(bool isFlat)
        {
            DeformableSurface skin = Build(new SheetLook(3, 0.1, isFlat), Tetrahedron, Sides);
            CheckWinding(skin);
            Assert.AreEqual(isFlat ? 12 : 4, skin.Positions.Length / 3);
            Double3 middle = new Double3(-0.25, 0.25, 0.25);
            for (int i = 0; i < skin.Positions.Length / 3; i++) Assert.Greater(Double3.Dot(At(skin.Positions, i) - middle, At(skin.Normals, i)), 0.0);
        }

        [Test]
        public void CornersKeepTheirPlacesInATexture()
        {
            // To the right and down: (0, 1) is the lower left corner, that of vertex 0.
            float[] uv = { 0, 1, 1, 1, 1, 0, 0, 1, 1, 0, 0, 0 };
            DeformableSurface cloth = Build(new SheetLook(2, 0.0, false), Square, Elements, uv);
            CheckWinding(cloth);
            Assert.AreEqual(4, cloth.Positions.Length / 3);
            for (int i = 0; i < 4; i++)
            {
                // To the right and up: u grows with x of the wire (z of Unity), v with y (-x).
                Assert.AreEqual(0.5f + 0.5f * cloth.Positions[3 * i + 2], cloth.Uv[2 * i]);
                Assert.AreEqual(0.5f - 0.5f * cloth.Positions[3 * i], cloth.Uv[2 * i + 1]);
            }
        }

        [Test]
        public void ARopeIsATubeAroundItsPieces()
        {
            float[] line = { 0, 0, 0, 1, 0, 0, 1, 2, 0, 1, 2, 3 };
            DeformableSurface rope = Build(new SheetLook(1, 0.05, false), line, new[] { 0, 1, 1, 2, 2, 3 });
            CheckWinding(rope);
            int aPiece = rope.Positions.Length / 9;
            for (int i = 0; i < rope.Positions.Length / 3; i++)
            {
                int piece = i / aPiece;
                Double3 from = At(UnityPoints(line), piece), to = At(UnityPoints(line), piece + 1);
                Double3 along = (1.0 / (to - from).Length) * (to - from), way = At(rope.Positions, i) - from;
                Assert.AreEqual(0.05, (way - Double3.Dot(way, along) * along).Length, 1e-6);
                Assert.AreEqual(0.0, Double3.Dot(At(rope.Normals, i), along), 1e-6);
            }
        }

        private static float[] UnityPoints(float[] wire)
        {
            float[] points = (float[])wire.Clone();
            UnityAxes.PointsToUnity(points, points, points.Length / 3);
            return points;
        }

        [Test]
        public void VerticesOfAnotherOneAreRefused()
        {
            DeformableSurface cloth = Build(new SheetLook(2, 0.1, false), Square, Elements);
            float[] before = cloth.Positions.ToArray();
            Assert.IsFalse(cloth.Build(new float[9]));
            CollectionAssert.AreEqual(before, cloth.Positions);
        }

        [Test]
        public void FramesAllocateNothing()
        {
            DeformableSurface cloth = Build(new SheetLook(2, 0.1, true), Square, Elements);
            DeformableSurface rope = Build(new SheetLook(1, 0.1, false), Square, Elements);
            long before = GC.GetAllocatedBytesForCurrentThread();
            for (int i = 0; i < 100; i++)
            {
                cloth.Build(Square);
                rope.Build(Square);
            }
            Assert.AreEqual(0, GC.GetAllocatedBytesForCurrentThread() - before);
        }
    }
}
