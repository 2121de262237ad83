// Questions of other participants who ask for one's robot, oldest first.
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Interaction
{
    /// <summary>A question of another participant who asks for one's robot.</summary>
    public sealed class ConsentQuestion
    {
        public long ConsentId;
        public string Target = "";
        public string Requester = "";

        /// <summary>On the clock of readings [ns].</summary>
        public long UntilNs;
    }

    /// <summary>Those that wait for an answer. For one thread.</summary>
    internal sealed class ConsentQuestions
    {
        /// <summary>Time to answer where the session does not state it.</summary>
        private const long AnswerNs = 15_000_000_000;
        private const int Most = 16;
        private readonly List<ConsentQuestion> waiting = new List<ConsentQuestion>();

        public void Add(ConsentRequested asked, long timeoutNs, long nowNs)
        {
            if (waiting.Count == Most) waiting.RemoveAt(0);
            waiting.Add(new ConsentQuestion { ConsentId = asked.ConsentId, Target = asked.Target, Requester = asked.Requester, UntilNs = nowNs + (timeoutNs > 0 ? timeoutNs : AnswerNs) });
        }

        /// <summary>The lease of a robot has changed: what was asked about it is void.</summary>
        public void Remove(string target) { waiting.RemoveAll(one => one.Target == target); }

        public void Remove(ConsentQuestion answered) { waiting.Remove(answered); }

        public void Clear() { waiting.Clear(); }

        /// <summary>Return the question to show now, null for none.</summary>
        public ConsentQuestion Find(long nowNs)
        {
            while (waiting.Count > 0 && waiting[0].UntilNs <= nowNs) waiting.RemoveAt(0);
            return waiting.Count > 0 ? waiting[0] : null;
        }
    }
}
