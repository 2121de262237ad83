// Bodies as a world shows them.
using IrisSession.Core;
using IrisSession.Interaction;

namespace IrisSession.Unity.Input
{
    /// <summary>What hands point at, of a world that is drawn.</summary>
    public sealed class WorldBodies : IBodies
    {
        private readonly IrisWorld world;

        public WorldBodies(IrisWorld world)
        {
            this.world = world;
        }

        public long Version { get { return Bodies == null ? 0 : Bodies.Version; } }

        private SceneBodies Bodies { get { return world.World?.Scene.Bodies; } }

        public long FindParent(long body) { return Bodies == null ? 0 : Bodies.FindParent(body); }

        public bool TryGetPosition(long body, out Double3 p_world_body)
        {
            p_world_body = default;
            return Bodies != null && Bodies.TryGetPosition(body, out p_world_body);
        }
    }
}
