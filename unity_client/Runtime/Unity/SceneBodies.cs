// Transforms of the bodies of a scene, below one root: the world of the session.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Interaction;
using UnityEngine;

namespace IrisSession.Unity
{
    /// <summary>One transform for each moving body. What does not move is fixed to the root.</summary>
    public sealed class SceneBodies : IBodies
    {
        private readonly Dictionary<long, SceneBody> bodies = new Dictionary<long, SceneBody>();
        private readonly Dictionary<long, Transform> transforms = new Dictionary<long, Transform>();
        private readonly Dictionary<long, RigidTransform> poses = new Dictionary<long, RigidTransform>();
        private Transform[] rows = new Transform[0];
        private long rowsVersion = -1;

        public SceneBodies(Transform root)
        {
            Root = root;
        }

        /// <summary>The frame of the session's world.</summary>
        public Transform Root { get; }

        public long Version { get; private set; }

        /// <summary>Poses in the world by id, as they are shown now.</summary>
        public IReadOnlyDictionary<long, RigidTransform> Poses { get { return poses; } }

        /// <summary>Return the transform of a body; the root for one that does not move, or is not known.</summary>
        public Transform Find(long body) { return transforms.TryGetValue(body, out Transform found) ? found : Root; }

        public long FindParent(long body) { return bodies.TryGetValue(body, out SceneBody found) && found.Parent > 0 ? found.Parent : 0; }

        public bool TryGetPosition(long body, out Double3 p_world_body)
        {
            bool isKnown = poses.TryGetValue(body, out RigidTransform pose);
            if (!isKnown && bodies.TryGetValue(body, out SceneBody found))
            {
                pose = found.T_world_body;
                isKnown = true;
            }
            p_world_body = pose.Position;
            return isKnown;
        }

        /// <summary>Make the bodies those of another plan. Bodies that stay keep their transforms, and all their pose if it is the same.</summary>
        public void Apply(ScenePlan plan, SceneChanges changes)
        {
            HashSet<long> begins = new HashSet<long>(changes.AddedBodies);
            begins.UnionWith(changes.ChangedBodies);
            HashSet<long> moving = new HashSet<long>();
            bodies.Clear();
            foreach (SceneBody body in plan.Bodies) bodies[body.Id] = body;
            foreach (SceneBody body in plan.Bodies)
            {
                if (!body.IsMoving) continue;
                moving.Add(body.Id);
                if (!transforms.TryGetValue(body.Id, out Transform transform))
                {
                    transform = new GameObject(body.Name).transform;
                    transform.SetParent(Root, false);
                    transforms[body.Id] = transform;
                    begins.Add(body.Id);
                }
                if (begins.Contains(body.Id)) Move(body.Id, transform, body.T_world_body);
            }
            foreach (long id in new List<long>(transforms.Keys)) if (!moving.Contains(id)) Remove(id);
            rowsVersion = -1;
            Version++;
        }

        /// <summary>Move the bodies to the poses that were chosen. Allocates nothing while the bodies are the same.</summary>
        public void Show(BodyPoses shown)
        {
            if (rowsVersion != shown.Version)
            {
                rowsVersion = shown.Version;
                rows = new Transform[shown.Count];
                for (int row = 0; row < rows.Length; row++) transforms.TryGetValue(shown.GetId(row), out rows[row]);
            }
            for (int row = 0; row < rows.Length; row++)
            {
                if (rows[row] is null || !shown.TryGetPose(row, out RigidTransform pose)) continue;
                Move(shown.GetId(row), rows[row], pose);
            }
        }

        private void Move(long id, Transform transform, RigidTransform T_world_body)
        {
            poses[id] = T_world_body;
            UnityValues.Place(transform, T_world_body);
        }

        private void Remove(long id)
        {
            UnityEngine.Object.Destroy(transforms[id].gameObject);
            transforms.Remove(id);
            poses.Remove(id);
        }
    }
}
