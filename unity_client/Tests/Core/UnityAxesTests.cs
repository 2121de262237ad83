// Handedness by what a person would see, not by signs: sides of triangles, turned hands, views of cameras.
using System;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class UnityAxesTests
    {
        private static readonly Double3 Forward = new Double3(1, 0, 0);
        private static readonly Double3 Left = new Double3(0, 1, 0);
        private static readonly Double3 Up = new Double3(0, 0, 1);
        private static readonly Float3 UnityForward = new Float3(0, 0, 1);
        private static readonly Float3 UnityRight = new Float3(1, 0, 0);
        private static readonly Float3 UnityUp = new Float3(0, 1, 0);

        [Test]
        public void PersonFacesForwardWithItsHandsAtTheirSides()
        {
            AssertNear(UnityForward, UnityAxes.ToUnity(Forward));
            AssertNear(UnityRight, UnityAxes.ToUnity(-Left));
            AssertNear(UnityUp, UnityAxes.ToUnity(Up));
        }

        [Test]
        public void PointsAndPosesComeBack()
        {
            RigidTransform pose = new RigidTransform(new Double3(0.5, -1.25, 2), DoubleQuaternion.FromAxisAngle(new Double3(1, 2, -3), 0.7));
            RigidTransform back = UnityAxes.FromUnity(UnityAxes.ToUnity(pose));
            Assert.AreEqual(pose.Position, back.Position);
            Assert.LessOrEqual(DoubleQuaternion.Angle(pose.Rotation, back.Rotation), 1e-6);
            Assert.AreEqual(1.0, DoubleQuaternion.Angle(default(DoubleQuaternion).Normalized, DoubleQuaternion.FromAxisAngle(Up, 1)), 1e-12);
        }

        [Test]
        public void RotationsMovePointsAlike()
        {
            Random random = new Random(3);
            for (int i = 0; i < 200; i++)
            {
                RigidTransform pose = RandomPose(random);
                Double3 point = RandomPoint(random);
                Float3 direct = UnityAxes.ToUnity(pose.TransformPoint(point));
                UnityPose moved = UnityAxes.ToUnity(pose);
                AssertNear(direct, Add(moved.Position, UnityRotate(moved.Rotation, UnityAxes.ToUnity(point))), 1e-4f);
            }
        }

        [Test]
        public void HandTurnedToTheLeftTurnsToTheLeftInUnity()
        {
            // A quarter turn to the left, seen from above: what pointed forward points left, which is -X in Unity.
            FloatQuaternion turn = UnityAxes.ToUnity(DoubleQuaternion.FromAxisAngle(Up, Math.PI / 2));
            AssertNear(new Float3(-1, 0, 0), UnityRotate(turn, UnityForward));
            // A hand that rolls its thumb to the right: up becomes right.
            FloatQuaternion roll = UnityAxes.ToUnity(DoubleQuaternion.FromAxisAngle(Forward, Math.PI / 2));
            AssertNear(UnityRight, UnityRotate(roll, UnityUp));
            // A hand that is raised in Unity, forward to up, is raised on the wire.
            float s = (float)Math.Sqrt(0.5);
            DoubleQuaternion raised = UnityAxes.FromUnity(new FloatQuaternion(-s, 0, 0, s));
            AssertNear(UnityUp, UnityAxes.ToUnity(raised.Rotate(Forward)));
        }

        [Test]
        public void TrianglesShowTheSameSide()
        {
            Random random = new Random(5);
            for (int i = 0; i < 100; i++)
            {
                Double3 a = RandomPoint(random), b = RandomPoint(random), c = RandomPoint(random);
                Double3 outside = Double3.Cross(b - a, c - a);
                float[] vertices = { (float)a.X, (float)a.Y, (float)a.Z, (float)b.X, (float)b.Y, (float)b.Z, (float)c.X, (float)c.Y, (float)c.Z };
                int[] triangle = { 0, 1, 2 };
                UnityAxes.PointsToUnity(vertices, vertices, 3);
                UnityAxes.FlipWinding(triangle);
                // Unity's front side is where its cross product of the edges points: clockwise in a left-handed frame.
                Float3 p = Vertex(vertices, triangle[0]), q = Vertex(vertices, triangle[1]), r = Vertex(vertices, triangle[2]);
                Float3 front = UnityCross(Subtract(q, p), Subtract(r, p));
                AssertNear(UnityAxes.ToUnity(outside), front, 1e-4f);
            }
        }

        [Test]
        public void ScaledCornerStandsAtTheSamePlace()
        {
            Double3 scale = new Double3(2, 3, 5);
            Double3 corner = new Double3(0.1, -0.2, 0.3);
            Float3 local = UnityAxes.ToUnity(corner);
            Float3 by = UnityAxes.ScaleToUnity(scale);
            AssertNear(UnityAxes.ToUnity(new Double3(scale.X * corner.X, scale.Y * corner.Y, scale.Z * corner.Z)), new Float3(local.X * by.X, local.Y * by.Y, local.Z * by.Z));
        }

        [Test]
        public void CamerasLookAtTheSamePointWithTheSameUp()
        {
            Random random = new Random(7);
            for (int i = 0; i < 100; i++)
            {
                RigidTransform camera = RandomPose(random);
                UnityPose view = UnityAxes.CameraToUnity(camera);
                AssertNear(UnityAxes.ToUnity(camera.Rotation.Rotate(-Up)), UnityRotate(view.Rotation, UnityForward), 1e-5f);
                AssertNear(UnityAxes.ToUnity(camera.Rotation.Rotate(Left)), UnityRotate(view.Rotation, UnityUp), 1e-5f);
                UnityPose optical = UnityAxes.OpticalFrameToUnity(camera);
                AssertNear(UnityAxes.ToUnity(camera.Rotation.Rotate(Up)), UnityRotate(optical.Rotation, UnityForward), 1e-5f);
                AssertNear(UnityAxes.ToUnity(camera.Rotation.Rotate(-Left)), UnityRotate(optical.Rotation, UnityUp), 1e-5f);
                AssertNear(UnityAxes.ToUnity(camera.Position), optical.Position, 0f);
                Assert.LessOrEqual(DoubleQuaternion.Angle(camera.Rotation, UnityAxes.OpticalFrameFromUnity(optical).Rotation), 1e-6);
            }
        }

        [Test]
        public void GoldenConversions()
        {
            foreach (Json vector in Golden.Load("golden")["conversions"].Items)
            {
                double[] world = vector["world"].Doubles();
                double[] unity = vector["unity"].Doubles();
                UnityPose pose = UnityAxes.RowToUnity(world, 0);
                float[] shown = { pose.Position.X, pose.Position.Y, pose.Position.Z, pose.Rotation.X, pose.Rotation.Y, pose.Rotation.Z, pose.Rotation.W };
                for (int k = 0; k < 7; k++) Assert.AreEqual((float)unity[k], shown[k]);
                double[] back = new double[7];
                UnityAxes.FromUnity(pose).WriteRow(back, 0);
                for (int k = 0; k < 7; k++) Assert.AreEqual(world[k], back[k], 1e-6);
            }
        }

        [Test]
        public void TransformsCompose()
        {
            Random random = new Random(11);
            RigidTransform a = RandomPose(random), b = RandomPose(random);
            Double3 p = RandomPoint(random);
            Assert.LessOrEqual(((a * b).TransformPoint(p) - a.TransformPoint(b.TransformPoint(p))).Length, 1e-12);
            Assert.LessOrEqual((a.Inverse.TransformPoint(a.TransformPoint(p)) - p).Length, 1e-12);
        }

        private static Double3 RandomPoint(Random random)
        {
            return new Double3(2 * random.NextDouble() - 1, 2 * random.NextDouble() - 1, 2 * random.NextDouble() - 1);
        }

        private static RigidTransform RandomPose(Random random)
        {
            return new RigidTransform(RandomPoint(random), DoubleQuaternion.FromAxisAngle(RandomPoint(random), 6 * random.NextDouble()));
        }

        // Unity's own formulas, written down independently: components of a left-handed frame.
        private static Float3 UnityRotate(FloatQuaternion q, Float3 v)
        {
            float x = 2 * q.X, y = 2 * q.Y, z = 2 * q.Z;
            return new Float3(
                (1 - (q.Y * y + q.Z * z)) * v.X + (q.X * y - q.W * z) * v.Y + (q.X * z + q.W * y) * v.Z,
                (q.X * y + q.W * z) * v.X + (1 - (q.X * x + q.Z * z)) * v.Y + (q.Y * z - q.W * x) * v.Z,
                (q.X * z - q.W * y) * v.X + (q.Y * z + q.W * x) * v.Y + (1 - (q.X * x + q.Y * y)) * v.Z);
        }

        private static Float3 UnityCross(Float3 a, Float3 b)
        {
            return new Float3(a.Y * b.Z - a.Z * b.Y, a.Z * b.X - a.X * b.Z, a.X * b.Y - a.Y * b.X);
        }

        private static Float3 Add(Float3 a, Float3 b) { return new Float3(a.X + b.X, a.Y + b.Y, a.Z + b.Z); }

        private static Float3 Subtract(Float3 a, Float3 b) { return new Float3(a.X - b.X, a.Y - b.Y, a.Z - b.Z); }

        private static Float3 Vertex(float[] vertices, int i) { return new Float3(vertices[3 * i], vertices[3 * i + 1], vertices[3 * i + 2]); }

        private static void AssertNear(Float3 expected, Float3 actual, float within = 1e-6f)
        {
            Assert.AreEqual(expected.X, actual.X, within);
            Assert.AreEqual(expected.Y, actual.Y, within);
            Assert.AreEqual(expected.Z, actual.Z, within);
        }
    }
}
