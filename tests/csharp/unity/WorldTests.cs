// Other people, a ghost, another scene, and what may go wrong.
using System;
using System.Collections.Generic;
using System.Linq;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Interaction.Tests;
using IrisSession.Protocol;
using NUnit.Framework;
using Standins;
using UnityEngine;
using Pose = IrisSession.Protocol.Pose;

namespace IrisSession.Unity.StandinTests
{
    [TestFixture]
    public sealed class WorldTests
    {
        private static PresenceItem See(string participant, string device, double x, double y, double z)
        {
            return new PresenceItem { Participant = participant, Device = device, Pose = new Pose { P = new[] { x, y, z }, Q = new[] { 1.0, 0.0, 0.0, 0.0 } } };
        }

        private static DrawCall FindDraw(string name) { return Engine.Draws.SingleOrDefault(each => each.Name == name); }

        [Test]
        public void OthersAreWhereTheirDevicesAre()
        {
            Stage stage = new Stage("lab");
            stage.Load();
            stage.Show(1);
            foreach (string id in new[] { "p1", "p2" }) stage.Source.People[id] = new ParticipantInfo { Id = id, Connected = true };
            PresenceItem[] items = { See("p1", Device.Head, 1.0, 2.0, 1.6), See("p1", Device.HandLeft, 1.0, 2.2, 1.0), See("p2", Device.Head, 0.0, 0.0, 1.7), See("p1", Device.Gaze, 0.0, 0.0, 0.0) };
            stage.World.Avatars.Add(items, items.Length, stage.Source.NewestNs, "p2");
            Engine.Step();
            Assert.IsNull(FindDraw("p2 head"), "we are where we are");
            Assert.IsNull(FindDraw("p1 gaze"));
            StandinTests.AssertNear(stage.Expect(1.0, 2.2, 1.0), FindDraw("p1 hand/left").Matrices[0].MultiplyPoint3x4(Vector3.zero));
            DrawCall head = FindDraw("p1 head");
            // Its visor is in front: x of the wire.
            Vector3[] drawn = head.Mesh.vertices.Select(head.Matrices[0].MultiplyPoint3x4).ToArray();
            Vector3 ahead = stage.Expect(2.0, 2.0, 1.6) - stage.Expect(1.0, 2.0, 1.6);
            Assert.Greater(drawn.Max(each => Vector3.Dot(each - stage.Expect(1.0, 2.0, 1.6), ahead)), 0.03f);
            Assert.AreEqual(0x3d / 255f, head.Material.GetVector(ShaderNames.BaseColor).x, 1e-6f);

            stage.Source.SessionNowNs = stage.Source.NewestNs + AvatarTable.StaleNs;
            Engine.Step();
            Assert.IsNotNull(FindDraw("p1 head"));
            stage.Source.SessionNowNs++;
            Engine.Step();
            Engine.Step();
            Assert.IsNull(FindDraw("p1 head"), "it has not been heard of");
            stage.CheckNoErrors();
        }

        [Test]
        public void PeopleWhoLeaveAreGone()
        {
            Stage stage = new Stage("lab");
            stage.Load();
            stage.Show(1);
            stage.Source.People["p1"] = new ParticipantInfo { Id = "p1", Connected = true };
            stage.World.Avatars.Add(new[] { See("p1", Device.Head, 1.0, 2.0, 1.6) }, 1, stage.Source.NewestNs, "");
            Engine.Step();
            Assert.IsNotNull(FindDraw("p1 head"));
            stage.Source.People.Clear();
            Engine.Step();
            Engine.Step();
            Assert.IsNull(FindDraw("p1 head"));
        }

        [Test]
        public void ManyPeopleAndACloudStayWithinTheBudget()
        {
            Stage stage = new Stage("aloha");
            stage.Load();
            stage.Show(1);
            List<PresenceItem> items = new List<PresenceItem>();
            for (int i = 0; i < 20; i++)
            {
                stage.Source.People["p" + i] = new ParticipantInfo { Id = "p" + i, Connected = true };
                foreach (string device in new[] { Device.Head, Device.HandLeft, Device.HandRight }) items.Add(See("p" + i, device, i, 0.0, 1.0));
            }
            stage.World.Avatars.Add(items, items.Count, stage.Source.NewestNs, "p0");
            Engine.Step();
            Assert.AreEqual(stage.Source.Plan.DrawCalls + AvatarTable.MaxAvatars, Engine.Draws.Count);
            Assert.LessOrEqual(Engine.Draws.Count, DrawBudget.Quest3.Calls);
            Assert.AreEqual(57 - AvatarTable.MaxAvatars, stage.World.Avatars.Dropped);
            int most = DrawBudget.Quest3.Scene.Objects + AvatarTable.MaxAvatars + 2 * GhostShape.MaxPieces;
            Assert.LessOrEqual(most, DrawBudget.Quest3.Calls - 8, "clouds and panels need some too");
        }

        [Test]
        public void AGhostOfTheHandIsAtItsTarget()
        {
            Stage stage = new Stage("aloha");
            stage.Load();
            stage.Show(1);
            int before = Engine.Draws.Count;
            SceneBody hand = stage.Source.Plan.Bodies.Single(each => each.Name == "left/gripper_base");
            RobotInfo robot = new RobotInfo { Name = "left", SiteBody = hand.Id, T_body_site = new Pose { P = new[] { 0.1, 0.0, 0.0 }, Q = new[] { 1.0, 0.0, 0.0, 0.0 } } };
            RigidTransform T_world_site = stage.World.Scene.Bodies.Poses[hand.Id] * new RigidTransform(new Double3(0.1, 0.0, 0.0), DoubleQuaternion.Identity);
            RigidTransform target = new RigidTransform(T_world_site.Position + new Double3(0.0, 0.0, 0.1), T_world_site.Rotation);
            stage.World.Ghosts[0].Show(robot, target, 0x3d9be9);
            Engine.Step();
            DrawCall[] ghost = Engine.Draws.Where(each => each.Name == "ghost of left").ToArray();
            Assert.Greater(ghost.Length, 2); // and both fingers
            Assert.LessOrEqual(ghost.Length, GhostShape.MaxPieces);
            foreach (DrawCall piece in ghost)
            {
                Assert.AreEqual(3000, piece.Material.renderQueue);
                Vector3 shifted = piece.Matrices[0].MultiplyPoint3x4(piece.Mesh.vertices[0]);
                Vector3 wanted = shifted - stage.World.World.localToWorldMatrix.MultiplyVector(new Vector3(0f, 0.1f, 0f));
                Assert.IsTrue(Engine.Draws.Any(each => ReferenceEquals(each.Mesh, piece.Mesh) && each.Matrices.Any(m => (m.MultiplyPoint3x4(piece.Mesh.vertices[0]) - wanted).magnitude < 1e-4f)));
            }
            stage.World.Ghosts[0].Hide();
            Engine.Step();
            Assert.AreEqual(before, Engine.Draws.Count);
            stage.CheckNoErrors();
        }

        [Test]
        public void AGhostFollowsTheHandThatDrives()
        {
            Stage stage = new Stage("aloha");
            stage.Load();
            stage.Show(1);
            SceneBody hand = stage.Source.Plan.Bodies.Single(each => each.Name == "right/gripper_base");
            Wearer wearer = new Wearer();
            wearer.Take(Side.Right, "right");
            wearer.Session.RobotTable["right"] = new RobotInfo { Name = "right", SiteBody = hand.Id, T_body_site = new Pose { P = new double[3], Q = new[] { 1.0, 0.0, 0.0, 0.0 } } };
            wearer.Session.LeaseTable["right"].Scale = 0.5;
            stage.Component.Ghosts = new HandGhosts(wearer.Input, wearer.Session);
            Engine.Step();
            Assert.IsNull(Engine.Draws.FirstOrDefault(each => each.Name == "ghost of right"), "the clutch is open");

            wearer[Side.Right].Squeeze = 1;
            wearer.Run(12);
            Engine.Step();
            RigidTransform pose = wearer[Side.Right].Pose;
            wearer[Side.Right].Pose = new RigidTransform(pose.Position + new Double3(0.0, 0.0, 0.1), pose.Rotation);
            wearer.Run();
            Engine.Step();
            DrawCall piece = Engine.Draws.First(each => each.Name == "ghost of right");
            Vector3 wanted = piece.Matrices[0].MultiplyPoint3x4(piece.Mesh.vertices[0]) - new Vector3(0f, 0.05f, 0f);
            Assert.IsTrue(Engine.Draws.Any(each => ReferenceEquals(each.Mesh, piece.Mesh) && each.Matrices.Any(m => (m.MultiplyPoint3x4(piece.Mesh.vertices[0]) - wanted).magnitude < 1e-4f)));

            wearer[Side.Right].Squeeze = 0;
            wearer.Run();
            Engine.Step();
            Assert.IsNull(Engine.Draws.FirstOrDefault(each => each.Name == "ghost of right"));
            stage.CheckNoErrors();
        }

        [Test]
        public void AnotherSceneKeepsWhatIsTheSame()
        {
            Stage stage = new Stage("lab");
            stage.Load();
            stage.Show(3);
            UnityEngine.Mesh cloth = FindDraw("cloth").Mesh, balls = Engine.Draws.Single(each => each.Matrices.Length == 30).Mesh;
            SceneSpec spec = stage.Source.ReadSpec();
            Visual glass = spec.Visuals.Single(each => each.Rgba[3] < 1.0);
            glass.Rgba = new[] { 1.0, 0.0, 0.0, 0.5 };
            spec.Deformables = spec.Deformables.Where(each => each.Name == "cloth").ToArray();
            stage.Source.Plan = new ScenePlan(spec, DrawBudget.Quest3.Scene);
            Engine.Step();
            stage.Load();
            Assert.AreSame(cloth, FindDraw("cloth").Mesh);
            Assert.AreSame(balls, Engine.Draws.Single(each => each.Matrices.Length == 30).Mesh);
            Assert.IsNull(FindDraw("rope"));
            Assert.AreEqual(1f, Engine.Draws.Single(each => each.Material.renderQueue == 3000).Material.GetVector(ShaderNames.BaseColor).x);
            stage.Show(0);
            Assert.AreEqual(6, Engine.Draws.Count);
        }

        [Test]
        public void ASceneBeyondTheBudgetIsShownInPart()
        {
            Stage stage = new Stage("lab");
            SceneSpec spec = stage.Source.ReadSpec();
            Body world = spec.Bodies[0];
            spec.Deformables = new Deformable[0];
            spec.Bodies = new[] { world }.Concat(Enumerable.Range(1, 400).Select(i => new Body { Id = i, Moving = true, T_parent_body = world.T_parent_body, T_world_body = world.T_world_body })).ToArray();
            spec.Visuals = Enumerable.Range(1, 400).Select(i => new Visual { Id = i, Body = i, T_body_visual = world.T_world_body, Geometry = new Geometry { Kind = GeometryKind.Box, Size = new[] { 0.001 * i, 0.1, 0.1 } }, Material = -1, Rgba = new[] { 1.0, 1.0, 1.0, 1.0 } }).ToArray();
            stage.Source.Plan = new ScenePlan(spec, DrawBudget.Quest3.Scene);
            Engine.Step();
            while (!stage.World.Scene.IsSettled) Engine.Step();
            Engine.Step();
            Assert.AreEqual(DrawBudget.Quest3.Scene.Objects, Engine.Draws.Count);
            Assert.AreEqual(1, stage.World.Scene.Problems.Count);
            CollectionAssert.IsEmpty(Engine.Errors);
        }

        [Test]
        public void DamagedAssetsAreSaidAndTheRestIsShown()
        {
            Stage stage = new Stage("lab");
            stage.Source.Damaged = new HashSet<string>(stage.Source.Plan.Assets.Select(each => each.Address));
            Engine.Step();
            while (!stage.World.Scene.IsSettled) Engine.Step();
            Engine.Step();
            Assert.AreEqual(3, stage.World.Scene.Problems.Count); // cloth, rope, texture
            Assert.AreEqual(4, Engine.Draws.Count);
            CollectionAssert.IsEmpty(Engine.Errors);
        }

        [Test]
        public void AWorldWithoutMaterialsSaysSo()
        {
            Stage stage = new Stage("lab");
            stage.Component.Materials.Points = null;
            stage.Component.Show(stage.Source);
            Engine.Step();
            Assert.IsNull(stage.World);
            Assert.Greater(stage.Component.Problem.Length, 0);
            CollectionAssert.IsEmpty(Engine.Errors);
        }

        [Test]
        public void ADefectEndsTheWorldAndNotTheApplication()
        {
            Stage stage = new Stage("lab");
            stage.Load();
            stage.Source.Error = new InvalidOperationException("a defect");
            Engine.Step();
            Engine.Step();
            Engine.Step();
            Assert.AreEqual(1, Engine.Errors.Count, "logged once");
            Assert.IsTrue(stage.Component.Problem.Contains("a defect"));
            CollectionAssert.IsEmpty(Engine.Draws);
            stage.Source.Error = null;
            stage.Component.Show(stage.Source);
            Assert.AreEqual("", stage.Component.Problem);
        }

        [Test]
        public void NothingIsLeftOfADestroyedWorld()
        {
            Engine.Reset();
            int meshes = UnityEngine.Mesh.Live, textures = Texture2D.Live;
            Stage stage = new Stage("lab");
            stage.Load();
            stage.Show(3);
            Assert.Less(meshes, UnityEngine.Mesh.Live);
            UnityEngine.Object.Destroy(stage.Tracking);
            Engine.Step();
            Engine.Step();
            CollectionAssert.IsEmpty(Engine.Draws);
            CollectionAssert.IsEmpty(Engine.Errors);
            Assert.AreEqual(0, GraphicsBuffer.Live);
            Assert.AreEqual(meshes, UnityEngine.Mesh.Live);
            Assert.AreEqual(textures, Texture2D.Live);
        }
    }
}
