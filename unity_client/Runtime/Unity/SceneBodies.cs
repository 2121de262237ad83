// Transforms of the bodies of a scene, below one root: the world of the session.
using System.Collections.Generic;
using IrisSession.Core;
using UnityEngine;

namespace IrisSession.Unity
{
    /// <summary>One transform for each moving body. What does not move is fixed to the root.</summary>
    public sealed class SceneBodies
    {
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

        /// <summary>Poses in the world by id, as they are shown now.</summary>
        public IReadOnlyDictionary<long, RigidTransform> Poses { get { return poses; } }

        /// <summary>Return the transform of a body; the root for one that does not move, or is not known.</summary>
        public Transform Find(long body) { return transforms.TryGetValue(body, out Transform found) ? found : Root; }

        /// <summary>Make the bodies those of another plan. Bodies that stay keep their transforms, and all their pose if it is the same.</summary>
        public void Apply(ScenePlan plan, SceneChanges changes)
        {
            HashSet<long> begins = new HashSet<long>(changes.AddedBodies);
            begins.UnionWith(changes.ChangedBodies);
            HashSet<long> moving = new HashSet<long>();
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
