// Episodes from the buttons of a controller: a countdown before one begins, and a second press before one ends. Its number is shown.
using System;
using IrisSession.Protocol;

namespace IrisSession.Interaction
{
    public enum EpisodeStep
    {
        Idle,

        /// <summary>It begins when the countdown is over; any press cancels.</summary>
        Countdown,
        Running,

        /// <summary>The same button once more ends it as a success.</summary>
        AskSuccess,

        /// <summary>The same button once more discards it.</summary>
        AskDiscard,
    }

    /// <summary>Counts down, asks again, and says what to send. For one thread.</summary>
    public sealed class EpisodeControl
    {
        /// <summary>Time to bring both hands to where they begin.</summary>
        public const long CountdownNs = 3_000_000_000;

        /// <summary>A question that has no answer for so long is withdrawn.</summary>
        private const long AskNs = 4_000_000_000;

        /// <summary>An answer to a request is waited for so long.</summary>
        private const long ReplyNs = 5_000_000_000;

        /// <summary>How long the outcome of the last episode is shown.</summary>
        private const long OutcomeNs = 4_000_000_000;

        private long untilNs;
        private long waitUntilNs = long.MinValue;
        private long outcomeUntilNs = long.MinValue;
        private EpisodeStep asked;
        private long runningNumber = -1;
        private long outcomeNumber;
        private string outcome = "";

        /// <summary>Number of the episode that runs, or of the next one.</summary>
        public long Number { get; private set; } = 1;

        public EpisodeStep Step { get; private set; }

        /// <summary>Whole seconds that are left of the countdown.</summary>
        public int SecondsLeft { get; private set; }

        /// <summary>True in the frame in which a second of the countdown begins: to be felt.</summary>
        public bool IsTick { get; private set; }

        /// <summary>Take the state of the session, and let time pass. Returns the action to request, an `EpisodeAction`; null for none.</summary>
        public string Update(EpisodeChanged episode, bool isReady, long nowNs)
        {
            IsTick = false;
            TakeEpisode(episode, nowNs);
            bool isRunning = runningNumber >= 0;
            if (!isReady && Step == EpisodeStep.Countdown) asked = EpisodeStep.Idle;
            if (asked == EpisodeStep.Countdown && isRunning) asked = EpisodeStep.Idle; // another participant began it
            if ((asked == EpisodeStep.AskSuccess || asked == EpisodeStep.AskDiscard) && (!isRunning || nowNs >= untilNs)) asked = EpisodeStep.Idle;
            string action = null;
            if (asked == EpisodeStep.Countdown && nowNs >= untilNs)
            {
                asked = EpisodeStep.Idle;
                waitUntilNs = nowNs + ReplyNs;
                action = EpisodeAction.Start;
            }
            Step = asked != EpisodeStep.Idle ? asked : isRunning ? EpisodeStep.Running : EpisodeStep.Idle;
            int left = Step == EpisodeStep.Countdown ? (int)((untilNs - nowNs + 999_999_999) / 1_000_000_000) : 0;
            IsTick = left > 0 && left != SecondsLeft;
            SecondsLeft = left;
            return action;
        }

        /// <summary>The lower button was pressed. Returns the action to request, null for none.</summary>
        public string PressLower(long nowNs)
        {
            if (nowNs < waitUntilNs) return null;
            switch (Step)
            {
                case EpisodeStep.Idle:
                    Begin(EpisodeStep.Countdown, nowNs + CountdownNs);
                    return null;
                case EpisodeStep.Running:
                    Begin(EpisodeStep.AskSuccess, nowNs + AskNs);
                    return null;
                case EpisodeStep.AskSuccess:
                    return End(EpisodeAction.Success, nowNs);
                default:
                    Begin(EpisodeStep.Idle, nowNs);
                    return null;
            }
        }

        /// <summary>The upper button was pressed. Returns the action to request, null for none.</summary>
        public string PressUpper(long nowNs)
        {
            if (nowNs < waitUntilNs) return null;
            switch (Step)
            {
                case EpisodeStep.Running:
                    Begin(EpisodeStep.AskDiscard, nowNs + AskNs);
                    return null;
                case EpisodeStep.AskDiscard:
                    return End(EpisodeAction.Discard, nowNs);
                default:
                    Begin(EpisodeStep.Idle, nowNs);
                    return null;
            }
        }

        /// <summary>The session has answered: another press counts again.</summary>
        public void Settle()
        {
            waitUntilNs = long.MinValue;
        }

        /// <summary>The headset was taken off, or is in the background: nothing begins by itself.</summary>
        public void Cancel()
        {
            asked = EpisodeStep.Idle;
        }

        /// <summary>Return the line about the episode, empty when there is nothing to say.</summary>
        public string Describe(long nowNs)
        {
            switch (Step)
            {
                case EpisodeStep.Countdown:
                    return "Episode " + Number + " begins in " + SecondsLeft + ": any button cancels";
                case EpisodeStep.AskSuccess:
                    return "Episode " + Number + ": press the lower button again for success";
                case EpisodeStep.AskDiscard:
                    return "Episode " + Number + ": press the upper button again to discard it";
                case EpisodeStep.Running:
                    return "Episode " + Number + " is recorded";
                default:
                    return nowNs < outcomeUntilNs ? "Episode " + outcomeNumber + ": " + outcome : "";
            }
        }

        private void TakeEpisode(EpisodeChanged episode, long nowNs)
        {
            bool isRunning = episode != null && episode.State == "running";
            if (runningNumber >= 0 && (!isRunning || episode.Number != runningNumber) && episode != null)
            {
                outcomeNumber = runningNumber;
                outcome = isRunning ? "ended" : episode.State;
                outcomeUntilNs = nowNs + OutcomeNs;
            }
            long before = runningNumber;
            runningNumber = isRunning ? episode.Number : -1;
            if (before != runningNumber) Settle();
            Number = isRunning ? episode.Number : episode == null ? 1 : episode.Number + 1;
        }

        private void Begin(EpisodeStep step, long until)
        {
            asked = step;
            Step = step == EpisodeStep.Idle && runningNumber >= 0 ? EpisodeStep.Running : step;
            untilNs = until;
        }

        private string End(string action, long nowNs)
        {
            asked = EpisodeStep.Idle;
            Step = EpisodeStep.Running;
            waitUntilNs = nowNs + ReplyNs;
            return action;
        }
    }
}
