// Shapes of the other participants, in the frames of their devices: x forward, y left, z up.
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Meshes of heads and hands.</summary>
    public static class AvatarShapes
    {
        /// <summary>Return a head with a visor, or a hand with a pointer.</summary>
        public static PartMesh Make(bool isHead)
        {
            return isHead
                ? Join(Shape(GeometryKind.Ellipsoid, -0.06, 0.0, 0.0, 0.085, 0.07, 0.1), Shape(GeometryKind.Box, 0.02, 0.0, 0.01, 0.03, 0.07, 0.035))
                : Join(Shape(GeometryKind.Ellipsoid, 0.0, 0.0, 0.0, 0.05, 0.04, 0.025), Shape(GeometryKind.Box, 0.1, 0.0, 0.0, 0.06, 0.003, 0.003));
        }

        private static Visual Shape(string kind, double x, double y, double z, double halfX, double halfY, double halfZ)
        {
            return new Visual
            {
                T_body_visual = new Pose { P = new[] { x, y, z }, Q = new[] { 1.0, 0.0, 0.0, 0.0 } },
                Geometry = new Geometry { Kind = kind, Size = new[] { halfX, halfY, halfZ } },
                Material = -1,
                Rgba = new[] { 1.0, 1.0, 1.0, 1.0 },
            };
        }

        private static PartMesh Join(params Visual[] shapes)
        {
            Body world = new Body { Parent = -1, T_world_body = new Pose { P = new double[3], Q = new[] { 1.0, 0.0, 0.0, 0.0 } } };
            ScenePlan plan = new ScenePlan(new SceneSpec { Bodies = new[] { world }, Visuals = shapes }, default);
            return PartMesh.Build(plan, plan.Parts[0], null, null);
        }
    }
}
