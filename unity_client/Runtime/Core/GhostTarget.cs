// Where a robot's hand goes while a clutch is closed: the law of iris_session/control/clutch.py, so that it can be seen before the
// arm moves. Limits of the workspace and of joints are the session's: the ghost may be where the arm does not get.
namespace IrisSession.Core
{
    /// <summary>The target of one hand.</summary>
    public sealed class GhostTarget
    {
        private RigidTransform T_world_device;
        private RigidTransform T_world_site;

        /// <summary>True while a clutch is closed.</summary>
        public bool IsLatched { get; private set; }

        /// <summary>The clutch has closed: from here on the target moves as the device does.</summary>
        public void Latch(RigidTransform device, RigidTransform site)
        {
            IsLatched = true;
            T_world_device = device;
            T_world_site = site;
        }

        /// <summary>The clutch is open.</summary>
        public void Release() { IsLatched = false; }

        /// <summary>Return `T_world_site` of the target: translation times `scale`, rotation about the axes of the world.</summary>
        public RigidTransform Follow(RigidTransform device, double scale)
        {
            Double3 moved = device.Position - T_world_device.Position;
            DoubleQuaternion turned = device.Rotation * T_world_device.Rotation.Conjugate;
            return new RigidTransform(T_world_site.Position + scale * moved, turned * T_world_site.Rotation);
        }
    }
}
