// The target of a clutch is that of the session: iris_session/control/clutch.py.
using System;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public sealed class GhostTargetTests
    {
        private static readonly Double3 Up = new Double3(0.0, 0.0, 1.0);

        private static RigidTransform At(double x, double y, double z, double yaw = 0.0)
        {
            return new RigidTransform(new Double3(x, y, z), DoubleQuaternion.FromAxisAngle(Up, yaw));
        }

        private static void AssertNear(RigidTransform expected, RigidTransform actual)
        {
            Assert.AreEqual(0.0, (expected.Position - actual.Position).Length, 1e-12);
            Assert.AreEqual(0.0, DoubleQuaternion.Angle(expected.Rotation, actual.Rotation), 1e-7);
        }

        [Test]
        public void ClosingMovesNothing()
        {
            GhostTarget target = new GhostTarget();
            target.Latch(At(1.0, 2.0, 3.0, 0.7), At(0.3, 0.2, 0.1, -0.4));
            Assert.IsTrue(target.IsLatched);
            AssertNear(At(0.3, 0.2, 0.1, -0.4), target.Follow(At(1.0, 2.0, 3.0, 0.7), 0.5));
        }

        [Test]
        public void TranslationIsScaledAndRotationIsAboutTheWorld()
        {
            GhostTarget target = new GhostTarget();
            RigidTransform site = new RigidTransform(new Double3(0.3, 0.2, 0.1), DoubleQuaternion.FromAxisAngle(new Double3(1.0, 0.0, 0.0), Math.PI / 2.0));
            target.Latch(At(1.0, 2.0, 3.0, 0.7), site);
            RigidTransform followed = target.Follow(At(1.2, 2.0, 2.9, 0.9), 0.5);
            AssertNear(new RigidTransform(new Double3(0.4, 0.2, 0.05), DoubleQuaternion.FromAxisAngle(Up, 0.2) * site.Rotation), followed);
            target.Release();
            Assert.IsFalse(target.IsLatched);
        }
    }
}
