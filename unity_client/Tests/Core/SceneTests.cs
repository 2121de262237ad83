// Specifications, levels of detail, plans and their differences.
using System;
using System.Collections.Generic;
using System.Globalization;
using System.IO;
using System.Linq;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class SceneTests
    {
        private const long Second = 1_000_000_000;

        private static Json Scenes { get { return Golden.Load("scene"); } }

        internal static List<string[]> LoadVectors(string kind, int least)
        {
            string folder = System.Environment.GetEnvironmentVariable("IRIS_VECTORS");
            if (folder == null) Assert.Ignore("the vectors are written by python -m tools.csharp test");
            List<string[]> rows = File.ReadLines(Path.Combine(folder, "scenes.txt")).Select(line => line.Split('\t')).Where(row => row[0] == kind).ToList();
            Assert.GreaterOrEqual(rows.Count, least);
            return rows;
        }

        internal static SceneSpec Decode(string hex)
        {
            byte[] data = Golden.FromHex(hex);
            return SceneDecoder.Decode(data, 0, data.Length);
        }

        private static SceneSpec EveryKind { get { return Decode(Scenes["scenes"].Items[0]["hex"].Text); } }

        [Test]
        public void GoldenScenesAreReadAndMalformedOnesRefused()
        {
            foreach (Json row in Scenes["scenes"].Items)
            {
                ScenePlan plan = new ScenePlan(Decode(row["hex"].Text), SceneBudget.Quest3);
                Assert.AreEqual(row["value"]["bodies"].Items.Count, plan.Bodies.Length);
            }
            foreach (Json row in Scenes["malformed"].Items) Assert.Throws<DecodeException>(() => Decode(row["hex"].Text), row["name"].Text);
            Assert.Throws<DecodeException>(() => SceneDecoder.Decode(new byte[SceneDecoder.MaxBytes + 1], 0, SceneDecoder.MaxBytes + 1));
        }

        [Test]
        public void LevelsAreThoseOfPython()
        {
            int hidden = 0;
            foreach (string[] row in LoadVectors("levels", 30))
            {
                SceneBudget budget = new SceneBudget(long.Parse(row[2]), long.Parse(row[3]), int.Parse(row[4]), 0);
                SceneLevels levels = SceneLevels.Choose(Decode(row[1]), budget);
                Assert.AreEqual(row[5], string.Join(",", levels.Meshes));
                Assert.AreEqual(row[6], string.Join(",", levels.Textures));
                Assert.AreEqual(row[7], string.Join(",", levels.Hidden.OrderBy(id => id)));
                Assert.AreEqual(double.Parse(row[8], CultureInfo.InvariantCulture), levels.Triangles);
                Assert.AreEqual(double.Parse(row[9], CultureInfo.InvariantCulture), levels.TextureBytes);
                Assert.AreEqual(row[10], levels.Objects.ToString());
                Assert.AreEqual(row[11] == "1", levels.Fits);
                hidden += levels.Hidden.Count;
            }
            Assert.Greater(hidden, 10);
        }

        [TestCase(TextureKind.Image, 4096, 1, 2)]
        [TestCase(TextureKind.Image, 1024, 0, 0)]
        [TestCase(TextureKind.Cube, 2048, 2, 3)]
        public void OneTextureIsUploadedWithinAFrame(string kind, int side, int ofQuest, int ofHoloLens)
        {
            TextureLevel[] levels = Enumerable.Range(0, 5).Select(k => new TextureLevel { Encoding = AssetEncoding.Png, Width = side >> k, Height = side >> k }).ToArray();
            SceneSpec spec = new SceneSpec { Textures = new[] { new Texture { Kind = kind, Levels = levels } } };
            Assert.AreEqual(ofQuest, SceneLevels.Choose(spec, DrawBudget.Quest3.Scene).Textures[0]);
            Assert.AreEqual(ofHoloLens, SceneLevels.Choose(spec, DrawBudget.HoloLens2.Scene).Textures[0]);
        }

        [Test]
        public void EveryShownVisualIsInOnePlaceOfOnePart()
        {
            foreach (string[] row in LoadVectors("levels", 30))
            {
                SceneSpec spec = Decode(row[1]);
                ScenePlan plan = new ScenePlan(spec, default);
                Dictionary<long, SceneBody> bodies = plan.Bodies.ToDictionary(body => body.Id);
                List<string> expected = new List<string>();
                foreach (Visual visual in spec.Visuals)
                {
                    if (visual.Rgba[3] == 0.0 || !spec.GroupsShown.Contains(visual.Group)) continue;
                    SceneBody body = bodies[visual.Body];
                    expected.Add(Describe(body.IsMoving ? body.Id : -1, visual.Geometry, (body.IsMoving ? RigidTransform.Identity : body.T_world_body) * SceneDecoder.ToTransform(visual.T_body_visual)));
                }
                List<string> actual = new List<string>();
                foreach (ScenePart part in plan.Parts)
                {
                    foreach (ScenePlace place in part.Places) foreach (SceneShape shape in part.Shapes) actual.Add(Describe(place.Body, shape.Geometry, place.T_body_part * shape.T_part_shape));
                }
                expected.Sort(string.CompareOrdinal);
                actual.Sort(string.CompareOrdinal);
                Assert.AreEqual(expected, actual);
                Assert.AreEqual(0, plan.HiddenCount + plan.UnusableCount);
            }
        }

        [Test]
        public void WhatLooksAlikeIsOneDrawCall()
        {
            SceneSpec spec = MakeBoxes(300, moving: true);
            ScenePlan plan = new ScenePlan(spec, SceneBudget.Quest3);
            Assert.AreEqual(1, plan.Parts.Length, "the same box on many bodies");
            Assert.AreEqual(300, plan.Parts[0].Places.Length);
            plan = new ScenePlan(MakeBoxes(300, moving: false), SceneBudget.Quest3);
            Assert.AreEqual(1, plan.Parts.Length, "boxes that stay are merged in the world");
            Assert.AreEqual(300, plan.Parts[0].Shapes.Length);
            foreach (Visual visual in spec.Visuals) visual.Rgba[3] = 0.5;
            plan = new ScenePlan(spec, SceneBudget.HoloLens2);
            Assert.AreEqual(50, plan.DrawCalls, "what is transparent stays apart, within the budget");
            Assert.AreEqual(250, plan.HiddenCount);
            Assert.IsFalse(plan.Fits);
            Assert.AreEqual(1, plan.Problems.Count);
        }

        [Test]
        public void NumbersThatCannotBeDrawnAreLeftOut()
        {
            SceneSpec spec = MakeBoxes(5, moving: true);
            spec.Visuals[0].T_body_visual.P[1] = double.NaN;
            spec.Visuals[1].Geometry.Size[0] = double.PositiveInfinity;
            spec.Visuals[2].Rgba[3] = double.NaN;
            spec.Bodies[4].T_world_body.P[2] = 1e30;
            ScenePlan plan = new ScenePlan(spec, SceneBudget.Quest3);
            Assert.AreEqual(3, plan.UnusableCount);
            Assert.AreEqual(1, plan.Parts.Sum(part => part.Places.Length));
        }

        [Test]
        public void AssetsAreNeededOnceCoarseOnesFirst()
        {
            foreach (string[] row in LoadVectors("levels", 30))
            {
                SceneSpec spec = Decode(row[1]);
                ScenePlan plan = new ScenePlan(spec, SceneBudget.Quest3);
                List<string> addresses = plan.Assets.Select(asset => asset.Address).ToList();
                Assert.AreEqual(addresses.Distinct().Count(), addresses.Count);
                HashSet<long> used = new HashSet<long>(plan.Parts.SelectMany(part => part.Shapes).Select(shape => shape.Geometry.Mesh));
                for (int m = 0; m < spec.Meshes.Length; m++)
                {
                    MeshLevel[] levels = spec.Meshes[m].Levels;
                    int coarse = addresses.IndexOf(levels[levels.Length - 1].Address);
                    int fine = addresses.IndexOf(levels[plan.Levels.Meshes[m]].Address);
                    Assert.AreEqual(used.Contains(m), coarse >= 0);
                    Assert.AreEqual(used.Contains(m), fine >= 0);
                    Assert.LessOrEqual(coarse, fine);
                }
                Assert.IsFalse(plan.Assets.Any(asset => asset.Encoding == AssetEncoding.Opaque));
            }
        }

        [Test]
        public void ChangesAreWhatIsRemovedAndAdded()
        {
            ScenePlan before = new ScenePlan(EveryKind, SceneBudget.Quest3);
            Assert.IsTrue(new SceneChanges(before, new ScenePlan(EveryKind, SceneBudget.Quest3)).IsEmpty);
            SceneChanges all = new SceneChanges(null, before);
            Assert.AreEqual(before.Parts.Length, all.AddedParts.Count);
            Assert.AreEqual(before.Assets.Length, all.AddedAssets.Count);
            Assert.IsTrue(all.IsLightingChanged);

            ScenePlan boxes = new ScenePlan(MakeBoxes(3, moving: true), SceneBudget.Quest3);
            SceneSpec spec = MakeBoxes(3, moving: true);
            spec.Visuals[1].Rgba[0] = 0.25;
            SceneChanges one = new SceneChanges(boxes, new ScenePlan(spec, SceneBudget.Quest3));
            Assert.AreEqual(1, one.RemovedParts.Count);
            Assert.AreEqual(2, one.AddedParts.Count, "the box of another colour, and the two others");
            Assert.AreEqual(0, one.ChangedBodies.Count + one.AddedAssets.Count);
            Assert.IsFalse(one.IsLightingChanged);

            spec = MakeBoxes(4, moving: true);
            spec.Bodies[1].T_world_body.P[0] = 7.0;
            spec.Environment.Extent = 3.0;
            SceneChanges more = new SceneChanges(boxes, new ScenePlan(spec, SceneBudget.Quest3));
            Assert.AreEqual(new[] { 4L }, more.AddedBodies);
            Assert.AreEqual(new[] { 1L }, more.ChangedBodies);
            Assert.AreEqual(0, more.RemovedBodies.Count);
            Assert.IsTrue(more.IsLightingChanged);
            Assert.AreEqual(new[] { 4L }, new SceneChanges(new ScenePlan(spec, SceneBudget.Quest3), boxes).RemovedBodies);
        }

        [Test]
        public void ChangesHoldWhateverTheIndicesAre()
        {
            SceneSpec spec = EveryKind;
            ScenePlan before = new ScenePlan(EveryKind, SceneBudget.Quest3);
            // Another material in front: every index of materials moves, and nothing looks otherwise.
            spec.Materials = new[] { new Material() }.Concat(spec.Materials).ToArray();
            foreach (Visual visual in spec.Visuals) if (visual.Material >= 0) visual.Material++;
            foreach (Site site in spec.Sites) if (site.Material >= 0) site.Material++;
            SceneChanges changes = new SceneChanges(before, new ScenePlan(spec, SceneBudget.Quest3));
            Assert.AreEqual(0, changes.AddedParts.Count + changes.RemovedParts.Count);
            Assert.AreEqual(Enumerable.Range(0, before.Parts.Length), changes.Kept);
        }

        [Test]
        public void FollowerFetchesTheSceneThatTheMirrorNames()
        {
            SceneFollower follower = new SceneFollower(SceneBudget.Quest3);
            SessionMirror mirror = new SessionMirror();
            List<SceneAsset> wanted = new List<SceneAsset>();
            List<string> cancelled = new List<string>();
            follower.Follow(mirror, 0);
            Assert.AreEqual(SceneState.Unknown, follower.State);
            string first = new string('a', 64);
            Name(mirror, first);
            follower.Follow(mirror, 0);
            follower.TakeWanted(wanted, cancelled);
            Assert.AreEqual(new[] { first }, wanted.Select(asset => asset.Address));
            follower.OnFailed(first, "unknown", 0);
            follower.Follow(mirror, Second / 2);
            Assert.AreEqual(0, follower.MissingCount, "not before a second");
            follower.Follow(mirror, Second);
            follower.TakeWanted(wanted, cancelled);
            Assert.AreEqual(new[] { first, first }, wanted.Select(asset => asset.Address));
            byte[] scene = EveryKind.Encode();
            follower.OnAsset(new string('9', 64), scene, 0, scene.Length);
            Assert.IsNull(follower.Plan, "it was not wanted");
            follower.OnAsset(first, scene, 0, scene.Length);
            Assert.AreEqual(first, follower.PlanHash);
            Assert.AreEqual(SceneState.Shown, follower.State);
            Assert.AreEqual(follower.Plan.Parts.Length, follower.TakeChanges().AddedParts.Count);
            Assert.IsNull(follower.TakeChanges());
            wanted.Clear();
            follower.TakeWanted(wanted, cancelled);
            Assert.AreEqual(follower.Plan.Assets, wanted);
            follower.OnFailed(wanted[0].Address, "unknown", 0);
            follower.OnAsset(wanted[1].Address, scene, 0, 0);
            Assert.AreEqual(wanted.Count - 2, follower.MissingCount);
            Assert.AreEqual(1, follower.FailedCount);

            // Another scene, which cannot be read: the one before stays, its assets are wanted no more.
            ScenePlan shown = follower.Plan;
            Name(mirror, new string('b', 64));
            follower.Follow(mirror, 0);
            follower.TakeWanted(wanted, cancelled);
            Assert.AreEqual(wanted.Count - 3, cancelled.Count);
            Assert.AreEqual(1, follower.MissingCount);
            follower.OnAsset(new string('b', 64), scene, 0, scene.Length - 1);
            Assert.AreEqual(SceneState.Unreadable, follower.State);
            Assert.AreSame(shown, follower.Plan);
            Assert.AreEqual(first, follower.PlanHash);
            Name(mirror, "model:abc");
            follower.Follow(mirror, 0);
            Assert.AreEqual(SceneState.NotShared, follower.State);
        }

        [Test]
        public void HostileScenesAreReadOrRefused()
        {
            int rounds = int.Parse(System.Environment.GetEnvironmentVariable("IRIS_FUZZ") ?? "1000");
            byte[][] golden = Scenes["scenes"].Items.Select(row => Golden.FromHex(row["hex"].Text)).ToArray();
            Random random = new Random(34);
            int read = 0;
            for (int i = 0; i < rounds; i++)
            {
                byte[] data = Hostile.Mutate(golden[random.Next(golden.Length)], random);
                try
                {
                    SceneSpec spec = SceneDecoder.Decode(data, 0, data.Length);
                    if (i % 8 != 0) continue;
                    ScenePlan plan = new ScenePlan(spec, SceneBudget.HoloLens2);
                    foreach (ScenePart part in plan.Parts) PartMesh.Build(plan, part, new NoAssets(), new ArrayDecoder());
                    Assert.IsNotNull(new SceneChanges(null, plan));
                    read++;
                }
                catch (DecodeException)
                {
                }
                catch (Exception error)
                {
                    Assert.Fail("{0} {1}", Golden.ToHex(data, 0, data.Length), error);
                }
            }
            Assert.Greater(read, 0);
        }

        private sealed class NoAssets : ISceneAssets
        {
            public byte[] Find(string address) { return null; }
        }

        private static void Name(SessionMirror mirror, string hash)
        {
            mirror.ApplySnapshot(new Snapshot { SceneHash = hash, EventSeq = mirror.EventSeq + 1 }, new List<InboxMessage>());
        }

        private static SceneSpec MakeBoxes(int count, bool moving)
        {
            Pose rest = new Pose();
            rest.Q[0] = 1.0;
            SceneSpec spec = new SceneSpec { Bodies = new Body[count + 1], Visuals = new Visual[count] };
            spec.Bodies[0] = new Body { Parent = -1, T_world_body = rest, T_parent_body = rest };
            for (int i = 0; i < count; i++)
            {
                Pose pose = new Pose();
                pose.P[0] = i;
                pose.Q[0] = 1.0;
                Pose place = new Pose();
                place.Q[0] = 1.0;
                spec.Bodies[i + 1] = new Body { Id = i + 1, Moving = moving, T_world_body = pose, T_parent_body = pose };
                spec.Visuals[i] = new Visual { Id = i, Body = i + 1, Material = -1, Rgba = new[] { 1.0, 1.0, 1.0, 1.0 }, T_body_visual = place, Geometry = new Geometry { Kind = GeometryKind.Box, Size = new[] { 0.1, 0.1, 0.1 } } };
            }
            return spec;
        }

        private static string Describe(long body, Geometry geometry, RigidTransform pose)
        {
            Double3 p = pose.Position;
            DoubleQuaternion q = pose.Rotation.W < 0.0 ? new DoubleQuaternion(-pose.Rotation.W, -pose.Rotation.X, -pose.Rotation.Y, -pose.Rotation.Z) : pose.Rotation;
            return string.Format(CultureInfo.InvariantCulture, "{0} {1} {2} {3:F6} {4:F6} {5:F6} {6:F6} {7:F6} {8:F6} {9:F6}", body, geometry.Kind, geometry.Mesh, p.X, p.Y, p.Z, q.W, q.X, q.Y, q.Z);
        }
    }
}
