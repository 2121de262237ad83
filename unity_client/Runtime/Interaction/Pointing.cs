// What a ray points at. A robot is the chain of its links from the base to the end effector, as thick as an arm; tests against
// meshes would take longer than a display frame. As web_client/src/xr/pointing.ts.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Interaction
{
    /// <summary>Bodies of the scene as they are shown.</summary>
    public interface IBodies
    {
        /// <summary>Changes with the bodies and their parents.</summary>
        long Version { get; }

        /// <summary>Return the parent of a body, 0 for the world or one that is not known.</summary>
        long FindParent(long body);

        /// <summary>Return where a body is shown, in the world; false while it has no place.</summary>
        bool TryGetPosition(long body, out Double3 p_world_body);
    }

    /// <summary>Finds robots at which a ray points.</summary>
    public sealed class Pointing
    {
        /// <summary>Distance from the axis of a link that counts as hit [m], and what is added per metre away [m].</summary>
        private const double RadiusM = 0.08;
        private const double Spread = 0.03;
        private const double ReachM = 8;

        /// <summary>Links of a robot; a chain that is longer is a fault of the scene.</summary>
        private const int MaxLinks = 64;

        private readonly Dictionary<string, long[]> chains = new Dictionary<string, long[]>();
        private readonly List<string> names = new List<string>();
        private readonly List<long> found = new List<long>();

        /// <summary>Names of the robots that have a chain.</summary>
        public List<string> Robots { get { return names; } }

        /// <summary>Take the robots of a scene. Call it when they, or the bodies, have changed.</summary>
        public void SetRobots(IEnumerable<RobotInfo> robots, IBodies bodies)
        {
            chains.Clear();
            names.Clear();
            foreach (RobotInfo robot in robots)
            {
                found.Clear();
                found.Add(robot.SiteBody);
                while (found[found.Count - 1] != robot.BaseBody && found.Count < MaxLinks)
                {
                    long parent = bodies.FindParent(found[found.Count - 1]);
                    if (parent == 0) break; // no link of the robot
                    found.Add(parent);
                }
                if (!chains.ContainsKey(robot.Name)) names.Add(robot.Name);
                chains[robot.Name] = found.ToArray();
            }
        }

        /// <summary>Return the robot that a ray of the world comes nearest to, and how far away it is [m]; empty when it passes all of them.</summary>
        public string FindPointed(AimRay ray, IBodies bodies, out double distanceM)
        {
            string best = "";
            double bestOffset = double.MaxValue;
            distanceM = 0;
            foreach (KeyValuePair<string, long[]> chain in chains)
            {
                bool hasLast = false;
                Double3 last = default;
                foreach (long body in chain.Value)
                {
                    if (!bodies.TryGetPosition(body, out Double3 at)) continue;
                    MeasureSegment(ray, hasLast ? last : at, at, out double distance, out double offset);
                    last = at;
                    hasLast = true;
                    if (distance > ReachM || offset > RadiusM + Spread * distance || offset >= bestOffset) continue;
                    best = chain.Key;
                    bestOffset = offset;
                    distanceM = distance;
                }
            }
            return best;
        }

        /// <summary>Return where the panel of a robot is: above the base, over its highest link, in the world.</summary>
        public bool TryFindTop(string robot, IBodies bodies, out Double3 base_top)
        {
            base_top = default;
            bool isFound = false;
            double top = 0;
            if (!chains.TryGetValue(robot, out long[] chain)) return false;
            foreach (long body in chain)
            {
                if (!bodies.TryGetPosition(body, out Double3 at)) continue;
                top = isFound ? Math.Max(top, at.Z) : at.Z;
                base_top = new Double3(at.X, at.Y, top);
                isFound = true;
            }
            return isFound;
        }

        /// <summary>Return how far along a ray a ball is, -1 when the ray passes it.</summary>
        public static double FindBall(AimRay ray, Double3 center, double radiusM)
        {
            Double3 offset = center - ray.Origin;
            double distance = Double3.Dot(offset, ray.Direction);
            double beside = (offset - distance * ray.Direction).Length;
            return distance > 0 && beside <= radiusM ? distance : -1;
        }

        /// <summary>Return how far along a ray it is nearest to the segment from `a` to `b`, and how far from it there.</summary>
        public static void MeasureSegment(AimRay ray, Double3 a, Double3 b, out double distance, out double offset)
        {
            Double3 link = b - a;
            Double3 toStart = a - ray.Origin;
            double square = Double3.Dot(link, link);
            double along = Double3.Dot(link, ray.Direction);
            double denominator = square - along * along;
            // Nearest points of two lines, with that of the link kept on it.
            double share = denominator > 1e-12 ? (along * Double3.Dot(toStart, ray.Direction) - Double3.Dot(link, toStart)) / denominator : 0;
            Double3 point = toStart + Math.Min(1, Math.Max(0, share)) * link;
            distance = Math.Max(0, Double3.Dot(point, ray.Direction));
            offset = (point - distance * ray.Direction).Length;
        }
    }
}
