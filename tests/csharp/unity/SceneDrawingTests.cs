// What is drawn of real scenes: where, from which side, in how many calls, in which colours.
using System;
using System.Collections.Generic;
using System.Linq;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Unity.Input;
using NUnit.Framework;
using Standins;
using UnityEngine;
using ColorSpace = IrisSession.Protocol.ColorSpace;

namespace IrisSession.Unity.StandinTests
{
    [TestFixture]
    public sealed class SceneDrawingTests
    {
        /// <summary>Lattice of poses (30 um, and 0.1 mrad at 0.5 m), float32, and exact meshes.</summary>
        private const float ToleranceM = 2e-4f;

        [Test]
        public void ArmsAreWhereMuJoCoHasThem()
        {
            Stage stage = new Stage("aloha");
            stage.Load();
            for (int state = 0; state < 2; state++)
            {
                stage.Show(1);
                Vector3[] drawn = Stage.ListDrawn();
                Assert.Greater(stage.Source.Probes.Count, 100);
                foreach (double[] probe in stage.Source.Probes) Stage.AssertDrawn(drawn, stage.Expect(probe[0], probe[1], probe[2]), ToleranceM);
            }
            WorldBodies bodies = new WorldBodies(stage.Component);
            foreach (KeyValuePair<long, double[]> body in stage.Source.Bodies)
            {
                Assert.IsTrue(bodies.TryGetPosition(body.Key, out Double3 at), "also of a base that is fixed");
                Assert.LessOrEqual((at - new Double3(body.Value[0], body.Value[1], body.Value[2])).Length, ToleranceM);
                if (!stage.Source.Plan.Bodies.Single(one => one.Id == body.Key).IsMoving) continue;
                StandinTests.AssertNear(stage.Expect(body.Value[0], body.Value[1], body.Value[2]), stage.World.Scene.Bodies.Find(body.Key).position, ToleranceM);
            }
            Assert.LessOrEqual(Engine.Draws.Count, DrawBudget.Quest3.Scene.Objects);
            Assert.AreEqual(stage.Source.Plan.DrawCalls, Engine.Draws.Count);
        }

        [Test]
        public void TrianglesAreSeenFromOutside()
        {
            foreach (string scene in new[] { "aloha", "lab" })
            {
                Stage stage = new Stage(scene);
                stage.Load();
                long right = 0, wrong = 0;
                foreach (DrawCall call in Engine.Draws.Where(each => !(each.Mesh is null)))
                {
                    Vector3[] vertices = call.Mesh.vertices, normals = call.Mesh.normals;
                    int[] corners = call.Mesh.triangles;
                    Matrix4x4 matrix = call.Matrices[0];
                    for (int i = 0; i < corners.Length; i += 3)
                    {
                        Vector3 a = matrix.MultiplyPoint3x4(vertices[corners[i]]), b = matrix.MultiplyPoint3x4(vertices[corners[i + 1]]), c = matrix.MultiplyPoint3x4(vertices[corners[i + 2]]);
                        Vector3 normal = matrix.MultiplyVector(normals[corners[i]] + normals[corners[i + 1]] + normals[corners[i + 2]]);
                        // Clockwise from outside in left-handed axes.
                        if (Vector3.Dot(Vector3.Cross(b - a, c - a), normal) >= 0f) right++;
                        else wrong++;
                    }
                }
                Assert.Greater(right, 1000);
                Assert.Less(wrong, 0.002 * right, scene);
                stage.Component.Show(null);
            }
        }

        [Test]
        public void NormalsPointOutOfABox()
        {
            Stage stage = new Stage("lab");
            stage.Load();
            Matrix4x4 place = default;
            UnityEngine.Mesh mesh = null;
            foreach (DrawCall call in Engine.Draws) if (call.Material.GetFloat(ShaderNames.Mapping) == 1f) (mesh, place) = (call.Mesh, call.Matrices[0]);
            Vector3[] vertices = mesh.vertices, normals = mesh.normals;
            Assert.AreEqual(36, vertices.Length);
            for (int i = 0; i < vertices.Length; i++) Assert.Greater(Vector3.Dot(place.MultiplyVector(vertices[i]), place.MultiplyVector(normals[i])), 0f);
            // Half lengths 0.1, 0.2, 0.3 along x, y, z of the wire: z, x, y of the engine.
            Assert.AreEqual(0.2f, vertices.Max(each => each.x), 1e-6f);
            Assert.AreEqual(0.3f, vertices.Max(each => each.y), 1e-6f);
            Assert.AreEqual(0.1f, vertices.Max(each => each.z), 1e-6f);
        }

        [Test]
        public void ThingsThatAreAlikeAreOneCall()
        {
            Stage stage = new Stage("lab");
            stage.Load();
            stage.Show(3);
            DrawCall balls = Engine.Draws.Single(each => each.Matrices.Length == 30);
            foreach (KeyValuePair<long, double[]> body in stage.Source.Bodies.OrderBy(each => each.Key).Take(30))
            {
                Vector3 wanted = stage.Expect(body.Value[0], body.Value[1], body.Value[2]);
                Assert.IsTrue(balls.Matrices.Any(each => (each.MultiplyPoint3x4(Vector3.zero) - wanted).magnitude < ToleranceM));
            }
            Assert.IsTrue(balls.Material.enableInstancing);
            // Floor, balls, box, glass, cloth, rope, cloud.
            Assert.AreEqual(7, Engine.Draws.Count);
        }

        [Test]
        public void MaterialsHaveTheColoursOfTheScene()
        {
            Stage stage = new Stage("lab");
            stage.Load();
            UnityEngine.Material glass = Engine.Draws.Single(each => each.Material.renderQueue == 3000).Material;
            Assert.AreEqual(0.4f, glass.GetVector(ShaderNames.BaseColor).w, 1e-6f);
            Assert.AreEqual(0f, glass.GetFloat(ShaderNames.DepthWrite));
            UnityEngine.Material box = Engine.Draws.Single(each => each.Material.GetFloat(ShaderNames.Mapping) == 1f).Material;
            Texture2D texture = (Texture2D)box.GetTexture(ShaderNames.BaseMap);
            Assert.AreEqual(8, texture.width);
            Assert.IsTrue(texture.IsUploaded);
            SceneSpec spec = stage.Source.Plan.Spec;
            Assert.AreEqual(spec.Textures[0].Colorspace == ColorSpace.Srgb, texture.isDataSRGB);
            // Rows from below: the red corner is that of u 0, v 1.
            Assert.AreEqual(255, texture.Pixels[4 * 8 * 3]);
            Assert.AreEqual(0, texture.Pixels[0]);
            Assert.AreEqual(TextureWrapMode.Repeat, texture.wrapMode);
        }

        [Test]
        public void DeformablesAreWrittenInPlace()
        {
            Stage stage = new Stage("lab");
            stage.Load();
            UnityEngine.Mesh mesh = Engine.Draws.Single(each => each.Name == "cloth").Mesh;
            Assert.IsTrue(mesh.IsDynamic);
            int uploads = mesh.Uploads;
            stage.Show(3);
            Assert.AreSame(mesh, Engine.Draws.Single(each => each.Name == "cloth").Mesh);
            Assert.AreEqual(uploads + 2, mesh.Uploads);
            DrawCall cloth = Engine.Draws.Single(each => each.Name == "cloth");
            Vector3[] drawn = mesh.vertices.Select(cloth.Matrices[0].MultiplyPoint3x4).ToArray();
            // Both sides are the radius of 2 mm away; frames of the stream are within 0.5 mm.
            foreach (double[] vertex in stage.Source.Vertices) Stage.AssertDrawn(drawn, stage.Expect(vertex[0], vertex[1], vertex[2]), 0.0026f);
            foreach (double[] vertex in stage.Source.Vertices)
            {
                float nearest = drawn.Min(each => (each - stage.Expect(vertex[0], vertex[1], vertex[2])).magnitude);
                Assert.Greater(nearest, 0.0014f);
            }
            stage.Show(1);
            Assert.AreEqual(uploads + 2, mesh.Uploads, "nothing moved");
            Bounds bounds = mesh.bounds;
            foreach (Vector3 vertex in mesh.vertices)
            {
                Assert.LessOrEqual((vertex - bounds.center).magnitude, 0.5f * bounds.size.magnitude + 1e-5f);
            }
        }

        [Test]
        public void CloudsBeyondThoseOfTheHeadsetAreSaidToBeMissing()
        {
            Stage stage = new Stage("lab");
            stage.Component.Draws = new DrawBudget(50, SceneBudget.HoloLens2, 0, 0, 0, false);
            stage.Component.Show(stage.Source);
            stage.Load();
            stage.Show(3);
            Assert.IsEmpty(Engine.Draws.Where(each => each.Mesh is null));
            Assert.AreEqual(1, stage.World.CloudsLeftOut);
            Assert.IsNotEmpty(stage.Component.Problem);
            stage.Component.Show(null);
            Assert.IsEmpty(stage.Component.Problem);
        }

        [Test]
        public void PointsAreInTheBuffer()
        {
            Stage stage = new Stage("lab");
            stage.Load();
            stage.Show(3);
            DrawCall cloud = Engine.Draws.Single(each => each.Mesh is null);
            Assert.AreEqual(6 * 10_000, cloud.Vertices);
            Assert.AreEqual(10_000, stage.World.PointsDrawn);
            byte[] bytes = ((GraphicsBuffer)cloud.Block.Properties.GetObject(ShaderNames.Points)).Bytes;
            Matrix4x4 lattice = cloud.Block.Matrices[ShaderNames.LatticeToWorld];
            // As the shader places them.
            Vector3[] drawn = new Vector3[10_000];
            for (int i = 0; i < drawn.Length; i++)
            {
                drawn[i] = lattice.MultiplyPoint3x4(new Vector3(BitConverter.ToUInt16(bytes, 8 * i), BitConverter.ToUInt16(bytes, 8 * i + 2), BitConverter.ToUInt16(bytes, 8 * i + 4)));
            }
            for (int i = 0; i < stage.Source.Points.Count; i += 97)
            {
                double[] point = stage.Source.Points[i];
                Stage.AssertDrawn(drawn, stage.Expect(point[0], point[1], point[2]), 1e-4f);
            }
            Assert.AreEqual(0.01f, cloud.Block.Properties.GetFloat(ShaderNames.PointSize), 1e-6f);
            stage.Component.Show(null);
            Assert.AreEqual(0, GraphicsBuffer.Live);
        }

        [Test]
        public void OldStateIsGrey()
        {
            Stage stage = new Stage("lab");
            stage.Load();
            Assert.AreEqual(1f, Shader.GetGlobalFloat(ShaderNames.Dimmed), "no state yet");
            stage.Show(1);
            Assert.AreEqual(0f, Shader.GetGlobalFloat(ShaderNames.Dimmed));
            stage.Source.SessionNowNs = stage.Source.NewestNs + 300_000_000;
            Engine.Step();
            Assert.AreEqual(0f, Shader.GetGlobalFloat(ShaderNames.Dimmed));
            stage.Source.SessionNowNs += 1_000_000;
            Engine.Step();
            Assert.AreEqual(1f, Shader.GetGlobalFloat(ShaderNames.Dimmed));
            stage.Show(1);
            Assert.AreEqual(0f, Shader.GetGlobalFloat(ShaderNames.Dimmed));
        }

        [Test]
        public void LightsAreWhereTheSceneHasThem()
        {
            Stage stage = new Stage("lab");
            stage.Load();
            Assert.AreEqual(1f, Shader.GetGlobalFloat(ShaderNames.LightCount));
            Vector4 place = Shader.GetGlobalVectorArray(ShaderNames.LightPositions)[0], way = Shader.GetGlobalVectorArray(ShaderNames.LightDirections)[0];
            StandinTests.AssertNear(stage.Expect(0.0, 0.0, 3.0), new Vector3(place.x, place.y, place.z));
            StandinTests.AssertNear(-Vector3.up, new Vector3(way.x, way.y, way.z));
        }

        [Test]
        public void AlignmentMovesTheWorld()
        {
            Stage stage = new Stage("lab");
            stage.Load();
            // The tracking frame is 1 m along x of the world, and turned to the left by 90 degrees.
            RigidTransform T_world_tracking = new RigidTransform(new Double3(1.0, 0.0, 0.0), DoubleQuaternion.FromAxisAngle(new Double3(0.0, 0.0, 1.0), Math.PI / 2.0));
            stage.World.SetAlignment(T_world_tracking);
            // A point 2 m along x of the world is then 1 m along -y of the tracking frame: to the right, x of the engine.
            Vector3 wanted = stage.Tracking.transform.TransformPoint(new Vector3(1f, 0f, 0f));
            StandinTests.AssertNear(wanted, stage.Expect(2.0, 0.0, 0.0));
        }

        [Test]
        public void WhatIsMissingComesLater()
        {
            Stage stage = new Stage("aloha");
            stage.Source.Hidden = new HashSet<string>(stage.Source.Plan.Assets.Select(each => each.Address));
            stage.Load();
            int few = Engine.Draws.Count;
            Assert.Less(few, 3);
            Assert.IsFalse(stage.World.Scene.IsComplete);
            stage.Source.Hidden = new HashSet<string>();
            stage.World.Scene.OnAssets();
            Engine.Step(1.0);
            stage.Load();
            Assert.IsTrue(stage.World.Scene.IsComplete);
            Assert.AreEqual(stage.Source.Plan.DrawCalls, Engine.Draws.Count);
        }

        [Test]
        public void WhatIsMissingComesLaterAlsoWhenTheSceneIsPatchedMeanwhile()
        {
            Stage stage = new Stage("lab");
            stage.Source.Hidden = new HashSet<string> { stage.Source.Plan.Deformables[0].Address };
            stage.Load();
            int few = Engine.Draws.Count;
            stage.Source.Plan = new ScenePlan(stage.Source.ReadSpec(), DrawBudget.Quest3.Scene);
            stage.Source.Hidden = new HashSet<string>();
            stage.Load();
            Assert.AreEqual(few + 1, Engine.Draws.Count);
        }

        [Test]
        public void AThingThatCannotBeMadeCostsNoOther()
        {
            Stage stage = new Stage("lab");
            stage.Source.Broken = new HashSet<string> { stage.Source.Plan.Deformables[0].Address };
            Engine.Step();
            while (!stage.World.Scene.IsSettled) Engine.Step();
            Assert.AreEqual(1, stage.World.Scene.Problems.Count);
            Assert.Greater(Engine.Draws.Count, 3);
        }

        [Test]
        public void FramesAllocateNothing()
        {
            Stage stage = new Stage("lab");
            stage.Load();
            stage.Show(3);
            Engine.IsRecording = false;
            for (int i = 0; i < 50; i++) Engine.Step();
            long before = GC.GetAllocatedBytesForCurrentThread();
            for (int i = 0; i < 200; i++)
            {
                stage.Source.SessionNowNs += 100_000;
                Engine.Step();
            }
            Assert.AreEqual(0, GC.GetAllocatedBytesForCurrentThread() - before);
        }
    }
}
