// The transform between two frames that are both level, from points that are known in both. As `fitLevel` of
// web_client/src/xr/poses.ts.
using System;
using System.Collections.Generic;

namespace IrisSession.Core
{
    /// <summary>A point in two frames.</summary>
    public readonly struct PointPair
    {
        public readonly Double3 From;
        public readonly Double3 To;

        public PointPair(Double3 from, Double3 to)
        {
            From = from;
            To = to;
        }
    }

    /// <summary>Fits a turn about the vertical and a shift.</summary>
    public static class LevelFit
    {
        /// <summary>Points nearer together than this do not tell a turn [m].</summary>
        private const double MinSpreadM = 0.05;

        /// <summary>Fit `T_to_from`. False for points that do not determine the turn.</summary>
        public static bool TryFit(List<PointPair> pairs, out RigidTransform T_to_from)
        {
            T_to_from = RigidTransform.Identity;
            if (pairs.Count < 2) return false;
            Double3 from = default;
            Double3 to = default;
            foreach (PointPair pair in pairs)
            {
                from += (1.0 / pairs.Count) * pair.From;
                to += (1.0 / pairs.Count) * pair.To;
            }
            double sine = 0;
            double cosine = 0;
            foreach (PointPair pair in pairs)
            {
                Double3 a = pair.From - from;
                Double3 b = pair.To - to;
                sine += a.X * b.Y - a.Y * b.X;
                cosine += a.X * b.X + a.Y * b.Y;
            }
            if (sine * sine + cosine * cosine < Math.Pow(MinSpreadM, 4)) return false;
            DoubleQuaternion turn = DoubleQuaternion.FromAxisAngle(new Double3(0, 0, 1), Math.Atan2(sine, cosine));
            T_to_from = new RigidTransform(to - turn.Rotate(from), turn);
            return true;
        }
    }
}
