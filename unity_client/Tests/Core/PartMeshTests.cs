// Shapes against those of Python, and parts in Unity's axes by real transforms.
using System;
using System.Collections.Generic;
using System.Linq;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class PartMeshTests
    {
        private sealed class Assets : ISceneAssets
        {
            public readonly Dictionary<string, byte[]> Bytes = new Dictionary<string, byte[]>();

            public byte[] Find(string address) { return Bytes.TryGetValue(address, out byte[] bytes) ? bytes : null; }
        }

        [Test]
        public void ShapesAreThoseOfPython()
        {
            foreach (string[] row in SceneTests.LoadVectors("shape", 20))
            {
                Geometry geometry = Geometry.Read(new WireReader(Golden.FromHex(row[1])));
                MeshArrays mesh = row[3].Length == 0 ? MeshArrays.FromPrimitive(geometry) : MeshArrays.FromHeightField(HeightField.Read(new WireReader(Golden.FromHex(row[3]))), ToFloats(row[4]));
                if (row[2].Length > 0) mesh = TextureCoordinates.Add(mesh, geometry, Material.Read(new WireReader(Golden.FromHex(row[2]))));
                int width = row[2].Length > 0 ? 8 : 6;
                float[] actual = Interleave(mesh, width);
                float[] expected = ToFloats(row[5]);
                Assert.AreEqual(expected.Length, actual.Length, geometry.Kind);
                CheckEachIsIn(actual, expected, width, geometry.Kind);
                CheckEachIsIn(expected, actual, width, geometry.Kind);
            }
        }

        [Test]
        public void TrianglesFaceOutwardsInUnity()
        {
            foreach (string kind in new[] { GeometryKind.Box, GeometryKind.Sphere, GeometryKind.Ellipsoid, GeometryKind.Cylinder, GeometryKind.Capsule, "later" })
            {
                PartMesh mesh = Build(new Geometry { Kind = kind, Size = new[] { 0.1, 0.2, 0.3 } }, RigidTransform.Identity, null);
                double volume = 0.0;
                for (int i = 0; i < mesh.Indices.Length; i += 3)
                {
                    Double3 a = Read(mesh.Positions, mesh.Indices[i]);
                    Double3 b = Read(mesh.Positions, mesh.Indices[i + 1]);
                    Double3 c = Read(mesh.Positions, mesh.Indices[i + 2]);
                    // Unity draws triangles that are clockwise to the eye; by its left hand, the cross product then points to the eye.
                    Double3 face = Double3.Cross(b - a, c - a);
                    Assert.Greater(Double3.Dot(face, Read(mesh.Normals, mesh.Indices[i])), 0.0, kind);
                    volume += Double3.Dot(a, Double3.Cross(b, c)) / 6.0;
                }
                Assert.Greater(volume, 0.0, kind);
            }
        }

        [Test]
        public void ShapesArePlacedAsTheirBodiesAre()
        {
            RigidTransform pose = new RigidTransform(new Double3(1.0, 2.0, 3.0), DoubleQuaternion.FromAxisAngle(new Double3(0.0, 0.0, 1.0), Math.PI / 2.0));
            PartMesh mesh = Build(new Geometry { Kind = GeometryKind.Box, Size = new[] { 0.1, 0.2, 0.3 } }, pose, null);
            // Half lengths x 0.1, y 0.2 turned by 90 degrees about up; Unity: right is -y, up is z, forward is x.
            double[] low = { double.MaxValue, double.MaxValue, double.MaxValue };
            double[] high = { double.MinValue, double.MinValue, double.MinValue };
            for (int i = 0; i < mesh.Positions.Length; i++)
            {
                low[i % 3] = Math.Min(low[i % 3], mesh.Positions[i]);
                high[i % 3] = Math.Max(high[i % 3], mesh.Positions[i]);
            }
            double[] expectedLow = { -2.1, 2.7, 0.8 };
            double[] expectedHigh = { -1.9, 3.3, 1.2 };
            for (int i = 0; i < 3; i++)
            {
                Assert.AreEqual(expectedLow[i], low[i], 1e-6);
                Assert.AreEqual(expectedHigh[i], high[i], 1e-6);
            }
        }

        [Test]
        public void MeshesOfAssetsAreBuiltOnceTheyAreHere()
        {
            Json row = Golden.Load("arrays")["assets"].Items.Find(asset => asset["name"].Text == "a mesh, exact");
            byte[] bytes = Golden.FromHex(row["hex"].Text);
            string address = new string('a', 64);
            SceneSpec spec = new SceneSpec
            {
                Bodies = new[] { new Body { Parent = -1 } },
                Meshes = new[] { new Mesh { Levels = new[] { new MeshLevel { Address = address, Encoding = AssetEncoding.Arrays } } } },
                Visuals = new[] { MakeVisual(new Geometry { Kind = GeometryKind.Mesh, Mesh = 0 }, RigidTransform.Identity) },
            };
            ScenePlan plan = new ScenePlan(spec, SceneBudget.Quest3);
            Assets assets = new Assets();
            Assert.IsNull(PartMesh.Build(plan, plan.Parts[0], assets, new ArrayDecoder()));
            assets.Bytes[address] = bytes;
            PartMesh mesh = PartMesh.Build(plan, plan.Parts[0], assets, new ArrayDecoder());
            MeshArrays raw = MeshArrays.FromAsset(new ArrayDecoder().Decode(bytes));
            Assert.AreEqual(raw.Indices.Length, mesh.Indices.Length);
            Double3 first = Read(raw.Positions, 0);
            Float3 there = UnityAxes.ToUnity(first);
            Assert.AreEqual(there, new Float3(mesh.Positions[0], mesh.Positions[1], mesh.Positions[2]));
            assets.Bytes[address] = new byte[10];
            Assert.Throws<DecodeException>(() => PartMesh.Build(plan, plan.Parts[0], assets, new ArrayDecoder()));
        }

        [Test]
        public void TexturesLieOnWhatIsMerged()
        {
            Material material = new Material { Textures = new[] { new TextureUse { Role = TextureRole.Rgb, Texture = 0 } } };
            foreach (string kind in new[] { TextureKind.Image, TextureKind.Cube })
            {
                PartMesh mesh = Build(new Geometry { Kind = GeometryKind.Capsule, Size = new[] { 0.1, 0.1, 0.3 } }, RigidTransform.Identity, material, kind);
                Assert.AreEqual(kind == TextureKind.Image, mesh.Uv != null);
                Assert.AreEqual(kind == TextureKind.Cube, mesh.CubeDirections != null);
                if (mesh.Uv != null) Assert.IsTrue(mesh.Uv.All(value => value >= -1e-6 && value <= 2.0));
                else Assert.IsTrue(mesh.CubeDirections.All(value => Math.Abs(value) <= 2.0 + 1e-6));
            }
        }

        private static PartMesh Build(Geometry geometry, RigidTransform pose, Material material, string textureKind = TextureKind.Image)
        {
            Visual visual = MakeVisual(geometry, pose);
            visual.Material = material == null ? -1 : 0;
            SceneSpec spec = new SceneSpec { Bodies = new[] { new Body { Parent = -1 } }, Visuals = new[] { visual } };
            if (material != null)
            {
                spec.Materials = new[] { material };
                spec.Textures = new[] { new Texture { Kind = textureKind, Channels = 3, Levels = new[] { new TextureLevel { Address = new string('b', 64), Encoding = AssetEncoding.Png } } } };
            }
            ScenePlan plan = new ScenePlan(spec, SceneBudget.Quest3);
            return PartMesh.Build(plan, plan.Parts[0], new Assets(), new ArrayDecoder());
        }

        private static Visual MakeVisual(Geometry geometry, RigidTransform pose)
        {
            Visual visual = new Visual { Material = -1, Rgba = new[] { 1.0, 1.0, 1.0, 1.0 }, Geometry = geometry };
            SampleBuilder.WritePose(pose, visual.T_body_visual);
            return visual;
        }

        private static float[] Interleave(MeshArrays mesh, int width)
        {
            List<float> values = new List<float>();
            foreach (int i in mesh.Indices)
            {
                for (int k = 0; k < 3; k++) values.Add(mesh.Positions[3 * i + k]);
                for (int k = 0; k < 3; k++) values.Add(mesh.Normals[3 * i + k]);
                for (int k = 0; k < width - 6; k++) values.Add(mesh.Uv[2 * i + k]);
            }
            return values.ToArray();
        }

        /// <summary>Fail unless each corner of one mesh, or each few, is one of the other: the order of triangles is free.</summary>
        private static void CheckEachIsIn(float[] some, float[] all, int width, string kind)
        {
            int step = Math.Max(1, some.Length / width / 150);
            for (int i = 0; i < some.Length / width; i += step)
            {
                double nearest = double.MaxValue;
                for (int j = 0; j < all.Length / width && nearest > 1e-4; j++)
                {
                    double difference = 0.0;
                    for (int k = 0; k < width && difference < nearest; k++) difference = Math.Max(difference, Math.Abs(some[i * width + k] - all[j * width + k]));
                    nearest = Math.Min(nearest, difference);
                }
                Assert.LessOrEqual(nearest, 1e-4, kind);
            }
        }

        private static Double3 Read(float[] values, int index) { return new Double3(values[3 * index], values[3 * index + 1], values[3 * index + 2]); }

        private static float[] ToFloats(string hex)
        {
            byte[] bytes = Golden.FromHex(hex);
            float[] values = new float[bytes.Length / 4];
            Buffer.BlockCopy(bytes, 0, values, 0, bytes.Length);
            return values;
        }
    }
}
