// The hand of a robot at its target: which parts of the scene belong to it, and where they would be.
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>One place of a part that moves with the hand.</summary>
    public readonly struct GhostPiece
    {
        /// <summary>Index in `ScenePlan.Parts`.</summary>
        public readonly int Part;
        public readonly long Body;
        public readonly RigidTransform T_body_part;

        internal GhostPiece(int part, ScenePlace place)
        {
            Part = part;
            Body = place.Body;
            T_body_part = place.T_body_part;
        }
    }

    /// <summary>The hand of one robot: the body of its site and everything below that.</summary>
    public sealed class GhostShape
    {
        /// <summary>Pieces that are drawn at most: each is a draw call.</summary>
        public const int MaxPieces = 6;
        public readonly IReadOnlyList<GhostPiece> Pieces;
        private readonly long siteBody;
        private readonly RigidTransform T_body_site;

        public GhostShape(ScenePlan plan, RobotInfo robot)
        {
            siteBody = robot.SiteBody;
            T_body_site = SceneDecoder.ToTransform(robot.T_body_site);
            Dictionary<long, long> parents = new Dictionary<long, long>();
            foreach (SceneBody body in plan.Bodies) parents[body.Id] = body.Parent;
            List<GhostPiece> pieces = new List<GhostPiece>();
            for (int part = 0; part < plan.Parts.Length; part++)
            {
                foreach (ScenePlace place in plan.Parts[part].Places)
                {
                    if (pieces.Count < MaxPieces && IsBelow(parents, place.Body)) pieces.Add(new GhostPiece(part, place));
                }
            }
            Pieces = pieces;
        }

        /// <summary>Return where a piece is when the site of the robot is at a pose, the fingers as they are now.</summary>
        public RigidTransform PlacePiece(GhostPiece piece, IReadOnlyDictionary<long, RigidTransform> bodies, RigidTransform T_world_target)
        {
            if (!bodies.TryGetValue(siteBody, out RigidTransform T_world_site_body) || !bodies.TryGetValue(piece.Body, out RigidTransform T_world_body))
            {
                return T_world_target;
            }
            RigidTransform T_site_piece = (T_world_site_body * T_body_site).Inverse * T_world_body * piece.T_body_part;
            return T_world_target * T_site_piece;
        }

        private bool IsBelow(Dictionary<long, long> parents, long body)
        {
            for (int depth = 0; depth <= parents.Count; depth++)
            {
                if (body == siteBody) return true;
                if (body <= 0 || !parents.TryGetValue(body, out body)) return false;
            }
            return false;
        }
    }
}
