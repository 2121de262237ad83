// What the hand feels when the feedback of its robot changes. As web_client/src/xr/words.ts, `findPulse`.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Interaction
{
    /// <summary>A vibration of a controller.</summary>
    public readonly struct Pulse
    {
        /// <summary>0 to 1; 0: none.</summary>
        public readonly float Intensity;
        public readonly float Seconds;

        public Pulse(float intensity, float seconds)
        {
            Intensity = intensity;
            Seconds = seconds;
        }

        public bool IsFelt { get { return Intensity > 0; } }

        /// <summary>A second of a countdown.</summary>
        public static Pulse Tick { get { return new Pulse(0.3f, 0.03f); } }

        /// <summary>A touch was taken.</summary>
        public static Pulse Touch { get { return new Pulse(0.6f, 0.06f); } }
    }

    /// <summary>Compares the feedback of robots with that before.</summary>
    public sealed class FeedbackPulses
    {
        /// <summary>Contact force that is felt fully [N].</summary>
        private const double FullN = 20;

        private readonly Dictionary<string, Feedback> newest = new Dictionary<string, Feedback>();

        /// <summary>Return the newest feedback of a robot, null for none.</summary>
        public Feedback Find(string robot)
        {
            return newest.TryGetValue(robot, out Feedback feedback) ? feedback : null;
        }

        /// <summary>Take a feedback. Returns what is felt.</summary>
        public Pulse Take(Feedback now)
        {
            Feedback before = Find(now.Robot);
            newest[now.Robot] = now;
            double contactBefore = before == null ? 0 : before.ContactN;
            if (now.ContactN > contactBefore) return new Pulse((float)Math.Min(1, 0.2 + now.ContactN / FullN), 0.04f);
            bool isRefused = now.HoldReason.Length > 0 && now.HoldReason != HoldReason.ClutchOpen && before != null && now.HoldReason != before.HoldReason;
            if (isRefused) return new Pulse(0.8f, 0.15f);
            foreach (string limit in now.Limits)
            {
                if (before == null || Array.IndexOf(before.Limits, limit) < 0) return new Pulse(0.4f, 0.06f);
            }
            return default;
        }

        /// <summary>Forget what other sessions said.</summary>
        public void Clear()
        {
            newest.Clear();
        }
    }
}
