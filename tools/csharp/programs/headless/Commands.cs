using System;
using System.Collections.Generic;
using System.Collections.Concurrent;
using System.Globalization;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Transport;

/// <summary>
/// Commands of a headset: `join`, `draw` (all of the scene by the Unity layer; instead of `scene`), `draw dimmed` (until the world is grey),
/// `align`, `marks` (align by touching those of a sheet), `acquire ROBOT`, `release ROBOT`, `episode ACTION`, `measure SECONDS`, `body NAME`, `view`,
/// `wait SECONDS`, `until TEXT` (an event of this kind), `estop`, `quit`; those of `Scenes`, `Driving` and `Streams`.
/// </summary>
internal sealed class Commands
{
    /// <summary>Places from which sheets are looked at, and frames at each.</summary>
    private const int EnoughPlaces = 3;
    private const int MaxPlaces = 20;
    private const int LookFrames = 40;

    private static readonly Dictionary<string, string> Arguments = new Dictionary<string, string>
    {
        { "acquire", "ROBOT" }, { "release", "ROBOT" }, { "move", "ROBOT X Y Z" }, { "touch", "ROBOT X Y Z" },
        { "episode", "ACTION" }, { "visual", "ID" }, { "follow", "COUNT FILE" }, { "media", "STREAM COUNT FILE" }, { "measure", "SECONDS" },
        { "body", "NAME" }, { "wait", "SECONDS" }, { "until", "EVENT" },
    };

    private readonly Headset headset;
    private readonly Report report;
    private readonly Driving driving;
    private readonly Scenes scenes;
    private readonly Streams streams;
    private int newsAt;
    private Drawing drawing;

    public Commands(Headset headset, Report report)
    {
        this.headset = headset;
        this.report = report;
        driving = new Driving(headset, report);
        scenes = new Scenes(headset, report);
        streams = new Streams(headset, report, scenes);
    }

    /// <summary>Run commands; frames go on while none has come. Returns whether all succeeded.</summary>
    public bool Run(IEnumerable<string> lines)
    {
        using (BlockingCollection<string> waiting = new BlockingCollection<string>())
        {
            new Thread(() =>
            {
                foreach (string line in lines) waiting.Add(line);
                waiting.CompleteAdding();
            }) { IsBackground = true }.Start();
            bool isDone = true;
            while (!waiting.IsCompleted && !headset.IsInterrupted && !headset.IsHopeless)
            {
                if (!waiting.TryTake(out string line))
                {
                    headset.Frame();
                    continue;
                }
                string[] words = line.Trim().Split(new[] { ' ' }, StringSplitOptions.RemoveEmptyEntries);
                if (words.Length == 0) continue;
                if (words[0] == "quit") break;
                isDone &= Check(words) && Do(words);
            }
            return isDone;
        }
    }

    private SessionClient Client { get { return headset.Client; } }

    /// <summary>True when a session could not be joined.</summary>
    public bool IsRefused { get; private set; }

    /// <summary>Return whether a command has its arguments, with numbers where it needs them.</summary>
    private bool Check(string[] words)
    {
        if (!Arguments.TryGetValue(words[0], out string wanted)) wanted = "";
        string[] names = wanted.Split(new[] { ' ' }, StringSplitOptions.RemoveEmptyEntries);
        bool isRight = words.Length > names.Length;
        for (int i = 0; isRight && i < names.Length; i++)
        {
            bool isNumber = names[i] == "SECONDS" || names[i] == "COUNT" || names[i] == "ID" || names[i].Length == 1;
            isRight = !isNumber || double.TryParse(words[i + 1], NumberStyles.Float, CultureInfo.InvariantCulture, out _);
        }
        if (!isRight) report.Write(words[0], false, "text", "it is written `" + words[0] + " " + wanted + "`");
        return isRight;
    }

    private bool Do(string[] words)
    {
        if (Client == null && words[0] != "join" && words[0] != "wait")
        {
            report.Write(words[0], false, "text", "no session was joined");
            return false;
        }
        switch (words[0])
        {
            case "join": return Join();
            case "scene": return scenes.Wait();
            case "draw": return Draw(words.Length > 1 ? words[1] : "");
            case "align": return Align();
            case "marks": return new Touching(headset).Run(report);
            case "acquire": return Acquire(words[1]);
            case "release": return Release(words[1]);
            case "move": return driving.Move(words[1], Vector(words, 2));
            case "touch": return driving.Touch(words[1], Vector(words, 2));
            case "visual": return scenes.ShowVisual((long)Number(words[1]));
            case "follow": return streams.Follow((int)Number(words[1]), words[2]);
            case "media": return streams.Receive(words[1], (int)Number(words[2]), words[3]);
            case "episode": return RequestEpisode(words[1]);
            case "measure": return Measure(Number(words[1]));
            case "body": return ShowBody(words[1]);
            case "view": return ShowView();
            case "wait": return Wait(Number(words[1]));
            case "until": return Until(words[1]);
            case "estop": return EStop();
            default:
                report.Write(words[0], false, "text", "unknown command");
                return false;
        }
    }

    private static Double3 Vector(string[] words, int at)
    {
        return new Double3(Number(words[at]), Number(words[at + 1]), Number(words[at + 2]));
    }

    private static double Number(string text)
    {
        return double.Parse(text, CultureInfo.InvariantCulture);
    }

    private bool Join()
    {
        bool isJoined = headset.RunUntil(() => headset.NeedsPerson || (IsRunning() && Client.View.Phase == ConnectionPhase.Ready && headset.States > 0));
        isJoined &= IsRunning() && Client.View.Phase == ConnectionPhase.Ready;
        IsRefused = !isJoined;
        headset.SendsSamples = isJoined && headset.SendsDevices;
        if (!IsRunning())
        {
            ConnectorView now = headset.Connector.View;
            report.Write(
                "join", false, "phase", now.Phase.ToString(), "text", now.Phrase.ToString(), "refusal", now.Refusal == null ? "" : now.Refusal.Code, "problem", now.Problem.Failure.ToString(),
                "fingerprint", now.Fingerprint);
            return false;
        }
        SessionView view = Client.View;
        report.Write(
            "join", isJoined, "phase", view.Phase.ToString(), "text", view.Text, "refusal", "", "problem", "None", "fingerprint", "", "participant", view.ParticipantId,
            "resumed", view.Welcome != null && view.Welcome.Resumed, "bodies", view.Bodies.Length, "robots", new List<string>(view.Robots.Keys).ToArray(), "scene", view.SceneHash, "crash", Client.Crash);
        return isJoined;
    }

    private bool IsRunning()
    {
        return headset.IsRunning;
    }

    private bool Draw(string what)
    {
        drawing = drawing ?? new Drawing(headset);
        bool wantsDimmed = what == "dimmed";
        return drawing.Write(report, drawing.Run(() => drawing.IsDimmed == wantsDimmed));
    }

    /// <summary>Look at each sheet from one place after the other, as a person would, until the session has an alignment.</summary>
    private bool Align()
    {
        int places = 0;
        bool isAligned = false;
        for (; places < MaxPlaces && !(isAligned && places >= EnoughPlaces); places++)
        {
            foreach (AnchorInfo anchor in Client.View.Anchors.Values) Look(anchor, 0.35 * places);
            isAligned = Client.View.AlignmentState == AlignmentState.Aligned;
        }
        Alignment found = Client.View.Alignment;
        double error = double.NaN;
        if (found != null)
        {
            RigidTransform T_found_true = Headset.ToTransform(found.T_world_tracking).Inverse * Headset.T_world_tracking;
            error = T_found_true.Position.Length;
        }
        report.Write("align", isAligned, "kind", found == null ? "" : found.Kind, "stated_m", found == null ? double.NaN : found.ErrorAtRobotM, "true_m", error, "places", places);
        return isAligned;
    }

    /// <summary>Walk to a place 0.6 m from a sheet, stand still, and report the sheet for a moment.</summary>
    private void Look(AnchorInfo anchor, double angle)
    {
        RigidTransform T_world_anchor = Headset.ToTransform(anchor.T_world_anchor);
        headset.WalkTo(T_world_anchor.Position + new Double3(0.4 * Math.Cos(angle), 0.4 * Math.Sin(angle), 0.45));
        SheetSighting sighting = new SheetSighting { AnchorId = anchor.Id, SizeM = anchor.SizeM };
        int frames = 0;
        headset.RunUntil(() =>
        {
            sighting.T_tracking_anchor = headset.ToTracking(T_world_anchor);
            sighting.T_tracking_camera = headset.ToTracking(headset.T_world_head);
            sighting.CaptureNs = Client.ToSessionNs(MonotonicClock.NowNs);
            if (frames % 3 == 0) Client.TryObserve(sighting);
            return ++frames > LookFrames;
        });
    }

    private bool Acquire(string robot)
    {
        Reply reply = Ask(new Acquire { Robots = new[] { robot } }, out string text);
        Denial denial = reply?.Denial;
        bool isOurs = reply != null && denial == null && headset.RunUntil(() => Client.View.IsOurs(robot), 10.0);
        report.Write(
            "acquire", isOurs, "robot", robot, "text", denial == null ? text : denial.Message, "reason", denial == null ? "" : denial.Reason, "holder", denial == null ? "" : denial.HolderName,
            "version", Client.View.Leases.TryGetValue(robot, out Lease lease) ? lease.LeaseVersion : -1);
        return isOurs;
    }

    private bool Release(string robot)
    {
        long version = Client.View.Leases.TryGetValue(robot, out Lease lease) ? lease.LeaseVersion : 0;
        Reply reply = Ask(new Release { Targets = new[] { new Target { Name = robot, LeaseVersion = version, Kind = TargetKind.Robot } } }, out string text);
        bool isDone = reply != null && reply.Denial == null;
        report.Write("release", isDone, "robot", robot, "text", text);
        return isDone;
    }

    private bool RequestEpisode(string action)
    {
        Reply reply = Ask(new Episode { Action = action }, out string text);
        bool isDone = reply != null && reply.Denial == null;
        report.Write("episode", isDone, "action", action, "text", reply?.Denial == null ? text : reply.Denial.Message);
        return isDone;
    }

    private Reply Ask(ClientMessage request, out string text)
    {
        long ticket = Client.Request(request);
        SessionNews found = default;
        bool isThere = headset.RunUntil(() =>
        {
            foreach (SessionNews one in headset.News) if (one.Kind == NewsKind.Reply && one.Ticket == ticket) found = one;
            return found.Ticket == ticket;
        });
        text = isThere ? found.Text ?? "" : "no reply";
        return found.Reply;
    }

    private bool Measure(double seconds)
    {
        headset.Ages.Clear();
        headset.States = headset.Frames = 0;
        headset.LongestCallMs = 0;
        int collections = GC.CollectionCount(0);
        headset.RunUntil(() => false, seconds);
        double[] ages = headset.Ages.ToArray();
        Array.Sort(ages);
        double p50 = ages.Length == 0 ? double.NaN : ages[ages.Length / 2];
        double p99 = ages.Length == 0 ? double.NaN : ages[(ages.Length - 1) * 99 / 100];
        report.Write(
            "measure", ages.Length > 0, "states", headset.States, "frames", headset.Frames, "age_ms_p50", p50, "age_ms_p99", p99, "longest_call_ms", headset.LongestCallMs,
            "recovery_ms", headset.RecoveryMs, "collections", GC.CollectionCount(0) - collections, "replaced", Client.StatesReplaced, "dropped_calls", Client.CallsDropped);
        return ages.Length > 0;
    }

    private bool ShowBody(string name)
    {
        SessionView view = Client.View;
        for (int row = 0; row < view.Bodies.Length; row++)
        {
            if (view.Bodies[row].Name != name || Client.State.BodiesVersion != view.BodiesVersion) continue;
            double[] pose = new double[7];
            Array.Copy(Client.State.Poses, 7 * row, pose, 0, 7);
            report.Write("body", true, "name", name, "pose", pose, "tick", Client.State.Tick, "state_seq", Client.State.StateSeq);
            return true;
        }
        report.Write("body", false, "name", name);
        return false;
    }

    private bool ShowView()
    {
        SessionView view = Client.View;
        List<string> ours = new List<string>();
        List<string> streams = new List<string>();
        if (view.Budget != null) foreach (StreamBudget one in view.Budget.Streams) streams.Add(one.Stream + " " + one.BudgetClass);
        foreach (Lease lease in view.Leases.Values) if (view.IsOurs(lease.Target)) ours.Add(lease.Target);
        headset.CountUnsent();
        report.Write(
            "view", true, "phase", view.Phase.ToString(), "text", view.Text, "ours", ours.ToArray(), "alignment", view.AlignmentState.ToString(), "event_seq", view.EventSeq, "scene", view.SceneHash,
            "endpoint", view.Endpoint == null ? "" : view.Endpoint.ToString(), "streams", streams.ToArray(), "stopped", view.IsStopped, "epoch", view.Welcome == null ? 0 : view.Welcome.ConnectionEpoch, "resumed", view.Welcome != null && view.Welcome.Resumed,
            "episode", view.Episode == null ? "" : view.Episode.Number + " " + view.Episode.State, "unsent", headset.Unsent, "crash", Client.Crash);
        return true;
    }

    private bool Wait(double seconds)
    {
        headset.RunUntil(() => false, seconds);
        report.Write("wait", !headset.IsInterrupted);
        return !headset.IsInterrupted;
    }

    /// <summary>Wait for an event of a kind, from the last one on.</summary>
    private bool Until(string kind)
    {
        string what = "";
        bool isThere = headset.RunUntil(() =>
        {
            for (; newsAt < headset.News.Count; newsAt++)
            {
                SessionNews one = headset.News[newsAt];
                if (one.Kind != NewsKind.Message || !(one.Message.Message is Event happened) || happened.Body.Tag != kind) continue;
                newsAt++;
                what = Describe(happened.Body);
                return true;
            }
            return false;
        });
        report.Write("until", isThere, "event", kind, "what", what);
        return isThere;
    }

    private string Describe(EventKind body)
    {
        string NameOf(string id)
        {
            return Client.View.Participants.TryGetValue(id, out ParticipantInfo info) ? info.Name : id;
        }

        switch (body)
        {
            case LeaseChanged changed: return changed.Lease.Target + " by " + NameOf(changed.Lease.Holder);
            case ParticipantJoined joined: return joined.Participant.Name;
            default: return "";
        }
    }

    private bool EStop()
    {
        Client.EStop("headless");
        bool isStopped = headset.RunUntil(() => Client.View.IsStopped, 10.0);
        report.Write("estop", isStopped);
        return isStopped;
    }
}
