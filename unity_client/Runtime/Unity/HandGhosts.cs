// Ghosts of the robots' hands that this wearer drives, one for each hand, while its clutch is closed.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Protocol;

namespace IrisSession.Unity
{
    /// <summary>Shows targets. Frames allocate nothing after the first ones.</summary>
    public sealed class HandGhosts
    {
        private readonly HeadsetInput input;
        private readonly ISessionPort session;
        private readonly GhostTarget[] targets = { new GhostTarget(), new GhostTarget() };
        private readonly string[] driven = { "", "" };

        public HandGhosts(HeadsetInput input, ISessionPort session)
        {
            this.input = input;
            this.session = session;
        }

        /// <summary>Show or hide the ghosts of a world. Once a frame, after the input.</summary>
        public void Show(WorldView world)
        {
            bool isAligned = session.TryGetAlignment(out RigidTransform T_world_tracking);
            for (int side = 0; side < targets.Length; side++)
            {
                string robot = input.Hands.FindDriven((Side)side);
                InputReading reading = input.Reading.Inputs[side];
                bool isShown = isAligned && robot.Length > 0 && input.Hands.IsSqueezing((Side)side) && reading.HasPose && session.Robots.ContainsKey(robot);
                if (!isShown || !TryShow(world, side, robot, T_world_tracking * reading.Pose))
                {
                    targets[side].Release();
                    world.Ghosts[side].Hide();
                }
            }
        }

        private bool TryShow(WorldView world, int side, string robot, RigidTransform T_world_device)
        {
            RobotInfo info = session.Robots[robot];
            IReadOnlyDictionary<long, RigidTransform> bodies = world.Scene.Bodies.Poses;
            if (!targets[side].IsLatched || driven[side] != robot)
            {
                if (!bodies.TryGetValue(info.SiteBody, out RigidTransform T_world_body)) return false;
                driven[side] = robot;
                targets[side].Latch(T_world_device, T_world_body * SceneDecoder.ToTransform(info.T_body_site));
            }
            double scale = session.Leases.TryGetValue(robot, out Lease lease) ? lease.Scale : 1.0;
            world.Ghosts[side].Show(info, targets[side].Follow(T_world_device, scale), AvatarTable.FindColor(session.ParticipantId));
            return true;
        }
    }
}
