// Bodies as a world shows them.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Interaction;

namespace IrisSession.Unity.Input
{
    /// <summary>What hands point at, of a world that is drawn.</summary>
    public sealed class WorldBodies : IBodies
    {
        private readonly IrisWorld world;
        private readonly Dictionary<long, long> parents = new Dictionary<long, long>();
        private ScenePlan parentsOf;

        public WorldBodies(IrisWorld world)
        {
            this.world = world;
        }

        public long FindParent(long body)
        {
            ScenePlan plan = world.World?.Scene.Plan;
            if (plan != parentsOf)
            {
                parentsOf = plan;
                parents.Clear();
                if (plan != null) foreach (SceneBody one in plan.Bodies) parents[one.Id] = one.Parent;
            }
            return parents.TryGetValue(body, out long parent) && parent > 0 ? parent : 0;
        }

        public bool TryGetPosition(long body, out Double3 p_world_body)
        {
            RigidTransform pose = RigidTransform.Identity;
            bool isShown = world.World != null && world.World.Scene.Bodies.Poses.TryGetValue(body, out pose);
            p_world_body = pose.Position;
            return isShown;
        }
    }
}
