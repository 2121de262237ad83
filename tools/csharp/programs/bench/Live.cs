using System;
using System.Collections.Generic;
using System.Globalization;
using System.IO;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Transport;

/// <summary>
/// Joins a session as an app does and logs the age of every state when an engine could take it. Prints `ready`; then each line
/// `measure BEGIN END FILE` (session time [ns]) of its input is answered by `done`, with a line `tick handed_ns state_ns` for each state
/// in FILE. It ends with its input, or when it has not joined in time.
/// </summary>
static class Live
{
    /// <summary>Period in which the newest state is taken [ms]: states that come at 60 Hz are not replaced before.</summary>
    const int PollMs = 2;

    /// <summary>The estimate of session time may be wrong by so much [ns]; by more, this runtime's clock is not that of the session.</summary>
    const long MaxClockErrorNs = 1_000_000_000;

    /// <summary>Time to join.</summary>
    const long JoinNs = 50_000_000_000;

    sealed class Memory : IIdentityStore
    {
        readonly byte[] secret = new byte[32];
        byte[] token = new byte[0];

        public Memory() { Guid.NewGuid().ToByteArray().CopyTo(secret, 0); }

        public byte[] Secret { get { return secret; } }
        public byte[] ResumeToken { get { return token; } }
        public void Remember(byte[] value) { token = value; }
    }

    public static int Run(string address, string name, long originNs)
    {
        var hello = new Hello { Role = Role.Observer, Name = name, Software = "bench", Alignment = AlignmentKind.NotNeeded };
        var client = new SessionClient(hello, new Memory(), new EndpointChooser(WebEndpoint.Parse(address)), new WebTransport());
        client.Start();
        var lines = new Queue<string>(); // the end of the input, as null, must be seen also while we join
        new Thread(() =>
        {
            string line;
            do
            {
                line = Console.ReadLine();
                lock (lines) lines.Enqueue(line);
            }
            while (line != null);
        }) { IsBackground = true }.Start();
        long until = MonotonicClock.NowNs + JoinNs;
        bool isReady = false;
        while (true)
        {
            if (!isReady && client.TakeState() && client.HasClock)
            {
                isReady = true;
                Console.WriteLine("ready");
            }
            if (!isReady && (client.View.Failure != null || client.HasEnded || MonotonicClock.NowNs > until))
            {
                Console.Error.WriteLine(name + " has not joined: " + client.View.Phase + ", " + client.View.Text + ", " + client.View.Problem + ", " + client.Crash);
                client.Stop();
                return 1;
            }
            string next = "";
            lock (lines) if (lines.Count > 0) next = lines.Dequeue();
            if (next == null) return client.Stop() ? 0 : 1;
            if (next.Length == 0)
            {
                Thread.Sleep(PollMs);
                continue;
            }
            string[] words = next.Split(new[] { ' ' }, 4);
            Measure(client, originNs, long.Parse(words[1], CultureInfo.InvariantCulture), long.Parse(words[2], CultureInfo.InvariantCulture), words[3]);
            Console.WriteLine("done");
        }
    }

    static void Measure(SessionClient client, long originNs, long beginNs, long endNs, string file)
    {
        var rows = new List<long>(3 * 8192);
        while (MonotonicClock.NowNs - originNs < endNs)
        {
            while (client.TryTakeNews(out _)) { }
            if (!client.TakeState())
            {
                Thread.Sleep(PollMs);
                continue;
            }
            StateFrame state = client.State;
            long now = MonotonicClock.NowNs;
            long error = client.ToSessionNs(now) - (now - originNs); // of the estimate in which the age was measured
            if (Math.Abs(error) > MaxClockErrorNs) throw new InvalidOperationException("the clock of this runtime is another one than the session's");
            long handed = state.SessionTimeNs + state.AgeNs - error;
            if (handed < beginNs || handed >= endNs) continue;
            rows.Add(state.Tick);
            rows.Add(handed);
            rows.Add(state.SessionTimeNs);
        }
        using (var log = new StreamWriter(file))
        {
            for (int i = 0; i < rows.Count; i += 3) log.WriteLine(rows[i] + " " + rows[i + 1] + " " + rows[i + 2]);
        }
    }
}
