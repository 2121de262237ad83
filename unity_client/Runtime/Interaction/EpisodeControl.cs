// The episode before the eyes: its task, number and countdown, and what can be done now. The session itself acts on the buttons of
// controllers; devices without buttons ask for the same actions.
using IrisSession.Protocol;

namespace IrisSession.Interaction
{
    /// <summary>Says how the episode stands, and what a press asks for. For one thread.</summary>
    public sealed class EpisodeControl
    {
        /// <summary>How long the outcome of the last episode is shown.</summary>
        private const long OutcomeNs = 4_000_000_000;

        private EpisodeChanged episode;
        private long outcomeUntilNs = long.MinValue;
        private bool isSeen;

        /// <summary>Whole seconds until the countdown, the question or the time to take it over ends; 0: nothing is waited for.</summary>
        public int SecondsLeft { get; private set; }

        /// <summary>True in the frame in which a second of the countdown begins: to be felt.</summary>
        public bool IsTick { get; private set; }

        /// <summary>Take the state of the session, and let its time pass.</summary>
        public void Update(EpisodeChanged now, long sessionNs)
        {
            if (!ReferenceEquals(now, episode))
            {
                bool wasOpen = episode != null && !IsOver;
                episode = now;
                if (wasOpen && IsOver) outcomeUntilNs = sessionNs + OutcomeNs;
            }
            bool isShown = !IsOver || sessionNs < outcomeUntilNs;
            isSeen = now != null && (isShown || now.Task.Length > 0);
            int left = now == null || now.UntilNs <= sessionNs ? 0 : (int)((now.UntilNs - sessionNs + 999_999_999) / 1_000_000_000);
            IsTick = left > 0 && left != SecondsLeft && now.State == EpisodeState.Countdown;
            SecondsLeft = left;
        }

        /// <summary>Return what the lower button asks for, an `EpisodeAction`; null: nothing now.</summary>
        public string FindLower()
        {
            if (IsOver) return EpisodeAction.Start;
            switch (episode.State)
            {
                case EpisodeState.Countdown: return null;
                case EpisodeState.Confirm: return EpisodeAction.Failure;
                case EpisodeState.Left: return EpisodeAction.TakeOver;
                default: return EpisodeAction.Success;
            }
        }

        /// <summary>Return what the upper button asks for; null: nothing now.</summary>
        public string FindUpper()
        {
            return IsOver || episode.State == EpisodeState.Left ? null : EpisodeAction.Discard;
        }

        /// <summary>Return the line about the episode, empty when there is nothing to say.</summary>
        public string Describe()
        {
            if (!isSeen) return "";
            string task = episode.Instruction.Length > 0 ? episode.Instruction + " " : "";
            string count = episode.Wanted > 0 ? ", " + episode.Successes + " of " + episode.Wanted : "";
            string advice = Advise();
            return task + "Episode " + episode.Number + count + (advice.Length > 0 ? ": " + advice : "");
        }

        private bool IsOver
        {
            get
            {
                if (episode == null) return true;
                switch (episode.State)
                {
                    case EpisodeState.Countdown:
                    case EpisodeState.Running:
                    case EpisodeState.Confirm:
                    case EpisodeState.Left:
                    case EpisodeState.Closing:
                        return false;
                    default:
                        return true;
                }
            }
        }

        private string Advise()
        {
            switch (episode.State)
            {
                case EpisodeState.Idle: return "the lower button begins the next one";
                case EpisodeState.Countdown: return "begins in " + SecondsLeft + ", the upper button cancels";
                case EpisodeState.Running: return "is recorded";
                case EpisodeState.Confirm: return "upper button again discards it, the lower one makes it a failure";
                case EpisodeState.Left: return "its leader is disconnected, it ends in " + SecondsLeft;
                case EpisodeState.Closing: return episode.Verdict.Length > 0 ? episode.Verdict : "lower button for success";
                default: return episode.State;
            }
        }
    }
}
