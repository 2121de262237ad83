// Poses of the bodies of a scene as they are shown: by their ids, interpolated, and whether they are too old.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Rows of state frames by the ids of bodies, at the delay of the display. Showing allocates nothing.</summary>
    public sealed class BodyPoses
    {
        public readonly PoseBuffer Buffer;
        private long[] ids = new long[0];
        private double[] shown = new double[0];
        private long newestEpoch = -1;

        public BodyPoses(long delayNs = 33_000_000)
        {
            Buffer = new PoseBuffer(delayNs);
        }

        public int Count { get { return ids.Length; } }

        /// <summary>Changes with the bodies that the rows are of.</summary>
        public long Version { get; private set; }

        /// <summary>Return the id of the body in a row.</summary>
        public long GetId(int row) { return ids[row]; }

        /// <summary>Return the pose in a row of the newest <see cref="TryShow"/>; false while the body has none.</summary>
        public bool TryGetPose(int row, out RigidTransform T_world_body)
        {
            T_world_body = RigidTransform.FromRow(shown, row);
            return !double.IsNaN(shown[7 * row]);
        }

        /// <summary>Take a new state.</summary>
        /// <param name="sessionTimeNs">Session time of its tick [ns].</param>
        /// <param name="sceneEpoch">That of the state.</param>
        /// <param name="rows">Rows `x y z qw qx qy qz`, world frame.</param>
        /// <param name="bodies">Bodies of the rows, in their order.</param>
        public void Add(long sessionTimeNs, long sceneEpoch, double[] rows, IReadOnlyList<BodyInfo> bodies)
        {
            if (rows.Length != 7 * bodies.Count) return; // between two scenes
            bool isSame = ids.Length == bodies.Count;
            for (int i = 0; isSame && i < ids.Length; i++) isSame = ids[i] == bodies[i].Id;
            if (!isSame)
            {
                ids = new long[bodies.Count];
                for (int i = 0; i < ids.Length; i++) ids[i] = bodies[i].Id;
                shown = new double[rows.Length];
                Version++;
            }
            // Across a jump of the scene nothing is interpolated.
            if (!isSame || sceneEpoch != newestEpoch) Buffer.Clear();
            newestEpoch = sceneEpoch;
            Buffer.Add(sessionTimeNs, rows);
        }

        /// <summary>Choose the poses to show at session time `nowNs`. False before the first state.</summary>
        public bool TryShow(long nowNs) { return Buffer.TryGetPoses(nowNs, shown, out _); }
    }
}
