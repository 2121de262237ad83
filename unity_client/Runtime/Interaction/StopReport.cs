// Whether an e-stop that was pressed has stopped robots: the wearer must not believe in one that went nowhere.
using IrisSession.Core;

namespace IrisSession.Interaction
{
    /// <summary>Follows the newest e-stop of this headset until the session says that robots are stopped. For one thread.</summary>
    public sealed class StopReport
    {
        /// <summary>A session that is joined confirms a stop within this time, or it is doubted.</summary>
        private const long ConfirmNs = 500_000_000;

        /// <summary>A stop that was never confirmed is spoken of for so long.</summary>
        private const long ShowNs = 60_000_000_000;

        /// <summary>Words about a stop that is not confirmed.</summary>
        public static readonly Phrase Unconfirmed = new Phrase("the e-stop of this headset has not reached the session", "use the stop of the robots themselves");

        private long pressedNs = long.MinValue;

        /// <summary>True while a stop is not confirmed: <see cref="Unconfirmed"/>.</summary>
        public bool IsUnconfirmed { get; private set; }

        /// <summary>It was pressed now.</summary>
        public void Press(long nowNs)
        {
            pressedNs = nowNs;
        }

        /// <summary>Take a frame. `session`: null without one.</summary>
        public void Update(ISessionPort session, long nowNs)
        {
            bool isJoined = session != null && session.IsJoined;
            if (pressedNs != long.MinValue && ((isJoined && session.IsStopped) || nowNs - pressedNs > ShowNs)) pressedNs = long.MinValue;
            IsUnconfirmed = pressedNs != long.MinValue && (!isJoined || nowNs - pressedNs > ConfirmNs);
        }
    }

    /// <summary>The e-stop alone, where everything else of the input has failed. For one thread.</summary>
    public sealed class StopInput
    {
        private readonly HandInput hands = new HandInput();
        private readonly WristStop wrist = new WristStop();

        /// <summary>Take a frame. Returns why it stops, null when it does not. `isLive`: input reaches this app.</summary>
        public string Update(HeadsetReading reading, bool isLive)
        {
            if (hands.TakeStops(reading)) return ByButton;
            if (!isLive) wrist.Suspend();
            return isLive && wrist.Update(reading) ? ByWrist : null;
        }

        internal const string ByButton = "button of a controller";
        internal const string ByWrist = "fingertip at the wrist";
        internal const string ByPanel = "panel of a headset whose input has failed";
    }
}
