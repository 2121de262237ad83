using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Protocol;
using IrisSession.Transport;

/// <summary>A wearer whose headset reads no codes: calibrates the tip of the right controller, and touches each mark of a sheet with it.</summary>
internal sealed class Touching
{
    /// <summary>Where the tip of the controller really is, in its own frame.</summary>
    private static readonly Double3 Tip = new Double3(0.05, 0.01, -0.06);
    private readonly Headset headset;
    private readonly SessionClientPort port;
    private readonly MarkTouching touching = new MarkTouching();
    private readonly HandContext context = new HandContext();
    private readonly HeadsetReading reading = new HeadsetReading();
    private int newsAt;
    private int turns;

    public Touching(Headset headset)
    {
        this.headset = headset;
        port = new SessionClientPort(headset.Client);
        newsAt = headset.News.Count;
        InputReading right = reading[Side.Right];
        right.IsPresent = right.HasPose = true;
        right.Validity = PoseValidity.Measured;
    }

    public bool Run(Report report)
    {
        Step();
        AnchorInfo sheet = touching.Marks.Sheet;
        touching.Begin();
        bool isDone = sheet != null && Calibrate(Headset.ToTransform(sheet.T_world_anchor).Position);
        while (isDone && touching.Stage == TouchStage.Touch) isDone = TouchNext(sheet);
        isDone &= headset.RunUntil(() => Step() && touching.Stage == TouchStage.Done, 10.0);
        Alignment found = headset.Client.View.Alignment;
        double error = double.NaN;
        if (found != null && sheet != null)
        {
            Double3 at = Headset.ToTransform(sheet.T_world_anchor).Position;
            RigidTransform T_found_true = Headset.ToTransform(found.T_world_tracking) * Headset.T_world_tracking.Inverse;
            error = (T_found_true.TransformPoint(at) - at).Length;
        }
        report.Write(
            "marks", isDone, "kind", found == null ? "" : found.Kind, "stated_m", found == null ? double.NaN : found.ErrorAtAnchorM, "true_m", error,
            "stage", touching.Stage.ToString(), "news", touching.News);
        return isDone;
    }

    /// <summary>Turn the controller while its tip is in a hole, until the session knows the tip.</summary>
    private bool Calibrate(Double3 hole)
    {
        PutTip(hole, DoubleQuaternion.Identity);
        if (!headset.RunUntil(() => Step() && touching.Stage == TouchStage.Tip, 10.0)) return false;
        Press(true);
        Step();
        Press(false);
        return headset.RunUntil(() =>
        {
            double direction = 0.1 * ++turns;
            Double3 axis = new Double3(Math.Cos(direction), Math.Sin(direction), 0.3 * Math.Sin(0.07 * turns));
            PutTip(hole, DoubleQuaternion.FromAxisAngle(axis, 0.6 * Math.Sqrt(turns % 300 / 300.0)));
            return Step() && touching.Stage == TouchStage.Touch;
        });
    }

    private bool TouchNext(AnchorInfo sheet)
    {
        string next = touching.Marks.Next;
        AnchorMark mark = Array.Find(sheet.Marks, one => one.Id == next);
        Double3 at = Headset.ToTransform(sheet.T_world_anchor).TransformPoint(new Double3(mark.PAnchor[0], mark.PAnchor[1], mark.PAnchor[2]));
        PutTip(at, DoubleQuaternion.FromAxisAngle(new Double3(0, 1, 0), 0.3));
        Press(false);
        Step();
        Press(true);
        return headset.RunUntil(() => Step() && touching.Marks.Next != next, 10.0);
    }

    private void Press(bool isPressed)
    {
        reading[Side.Right].Trigger = isPressed ? 1 : 0;
    }

    private void PutTip(Double3 at, DoubleQuaternion rotation)
    {
        headset.T_world_controller = new RigidTransform(at - rotation.Rotate(Tip), rotation);
    }

    /// <summary>Take a frame. Returns true.</summary>
    private bool Step()
    {
        for (IReadOnlyList<SessionNews> news = headset.News; newsAt < news.Count; newsAt++)
            if (news[newsAt].Kind == NewsKind.Message) touching.Take(news[newsAt].Message.Message, port);
        reading.CaptureNs = MonotonicClock.NowNs;
        reading[Side.Right].Pose = headset.ToTracking(headset.T_world_controller);
        touching.Update(reading, context, port, null, true);
        return true;
    }
}
