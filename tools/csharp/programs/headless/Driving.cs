using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Protocol;
using IrisSession.Transport;

/// <summary>A controller that moves a robot: `move ROBOT X Y Z` (world, metres) as far as that, `touch ROBOT X Y Z` until the hand feels a contact, and back.</summary>
internal sealed class Driving
{
    private const double MoveS = 2.0;
    private const double SettledM = 0.002;
    private const double ArrivedM = 0.005;
    /// <summary>The controller stands still while this process does: a hand that is far away afterwards would be a jump.</summary>
    private const double LongestStepS = 0.05;

    private readonly Headset headset;
    private readonly Report report;
    private double movedS;
    private long lastMovedNs;

    public Driving(Headset headset, Report report)
    {
        this.headset = headset;
        this.report = report;
    }

    /// <summary>Close the clutch, move the controller, and measure how far the end effector went.</summary>
    public bool Move(string robot, Double3 by)
    {
        if (!Begin("move", robot, out RigidTransform before)) return false;
        RigidTransform from = headset.T_world_controller;
        BeginWay();
        double error = double.NaN;
        bool isSettled = headset.RunUntil(() =>
        {
            double share = MoveController(from, by);
            if (share < 1.0 || !headset.TryGetSite(robot, out RigidTransform after)) return false;
            error = (after.Position - before.Position - by).Length;
            return error < SettledM;
        }, 30.0);
        bool isDone = error <= ArrivedM;
        End("move", robot, isDone, before, "error_mm", 1000.0 * error, "settled", isSettled);
        return isDone;
    }

    /// <summary>Close the clutch and move the controller until the robot reports a contact that is felt; then back to where it began.</summary>
    public bool Touch(string robot, Double3 by)
    {
        if (!Begin("touch", robot, out RigidTransform before)) return false;
        RigidTransform from = headset.T_world_controller;
        BeginWay();
        headset.ContactPulse = default;
        double contact = 0.0;
        bool isFelt = headset.RunUntil(() =>
        {
            MoveController(from, by);
            if (headset.Pulses.Find(robot) is Feedback now) contact = now.ContactN;
            return contact > 0.0 && headset.ContactPulse.IsFelt;
        }, 30.0);
        RigidTransform pressed = headset.T_world_controller;
        BeginWay();
        headset.RunUntil(() => MoveController(pressed, from.Position - pressed.Position) >= 1.0);
        End("touch", robot, isFelt, before, "contact_n", contact, "pulse", (double)headset.ContactPulse.Intensity);
        return isFelt;
    }

    private void BeginWay()
    {
        movedS = 0.0;
        lastMovedNs = MonotonicClock.NowNs;
    }

    /// <summary>Move the controller on, from rest to rest. Returns the share of the way.</summary>
    private double MoveController(RigidTransform from, Double3 by)
    {
        long nowNs = MonotonicClock.NowNs;
        movedS += Math.Min((nowNs - lastMovedNs) * 1e-9, LongestStepS);
        lastMovedNs = nowNs;
        double share = Math.Min(1.0, movedS / MoveS);
        headset.T_world_controller = new RigidTransform(from.Position + share * share * (3.0 - 2.0 * share) * by, from.Rotation);
        return share;
    }

    /// <summary>Drive a robot. Close the clutch, again after a reason for which the session wants it opened.</summary>
    private bool Begin(string command, string robot, out RigidTransform T_world_site)
    {
        T_world_site = RigidTransform.Identity;
        SessionView view = headset.Client.View;
        string why = !view.Robots.ContainsKey(robot) ? "no robot has this name" : !view.IsOurs(robot) ? "this robot is not yours: acquire it" : view.IsStopped ? Words.OfHold(HoldReason.Estop).ToString() : "";
        if (why.Length > 0)
        {
            report.Write(command, false, "robot", robot, "text", why);
            return false;
        }
        headset.Robots.Clear();
        headset.Robots.Add(robot);
        headset.RunUntil(() => headset.Pulses.Find(robot) != null, 2.0);
        for (int attempt = 0; attempt < 5; attempt++)
        {
            headset.Clutch = true;
            headset.Pulses.Clear();
            bool isEngaged = headset.RunUntil(() => headset.Pulses.Find(robot) is Feedback now && now.HoldReason.Length == 0, 3.0);
            if (isEngaged && headset.TryGetSite(robot, out T_world_site)) return true;
            headset.Clutch = false;
            headset.RunUntil(() => false, 0.3);
        }
        headset.TryGetSite(robot, out T_world_site);
        End(command, robot, false, T_world_site);
        return false;
    }

    /// <summary>Open the clutch, and write what became of the robot.</summary>
    private void End(string command, string robot, bool isDone, RigidTransform before, params object[] fields)
    {
        List<string> rejected = new List<string>();
        Feedback last = headset.Pulses.Find(robot);
        if (last != null) foreach (KeyValuePair<string, long> one in last.Rejected) rejected.Add(one.Key + " " + one.Value);
        headset.Clutch = false;
        headset.TryGetSite(robot, out RigidTransform at);
        List<object> all = new List<object> { "robot", robot, "moved_m", (at.Position - before.Position).Length, "hold", last == null ? "" : last.HoldReason, "text", last == null || last.HoldReason.Length == 0 ? "" : Words.OfHold(last.HoldReason).ToString(), "rejected", rejected.ToArray() };
        all.AddRange(fields);
        report.Write(command, isDone, all.ToArray());
    }
}
