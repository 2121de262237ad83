// The whole headset app on stand-ins of the engine, in a session that runs: it pairs, draws, is aligned by sheets, takes a robot by pointing at
// it, moves it with the clutch, and stops all. Writes a line of JSON for each; exit status 1 when one failed.
//
//     app run FOLDER ADDRESS NAME ROBOT      ADDRESS: a link of `iris-session pair --web`, or an address whose key is known in FOLDER
using System;
using System.Globalization;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Transport;
using IrisSession.Unity;
using Standins;
using UnityEngine;

internal static class Program
{
    private const int MaxPlaces = 20;
    private static bool isAllDone = true;

    private static int Main(string[] arguments)
    {
        if (arguments.Length != 5 || arguments[0] != "run")
        {
            Console.Error.WriteLine("app run FOLDER ADDRESS NAME ROBOT: files of the app, link of `iris-session pair --web`, name of the person, name of a robot");
            return arguments.Length == 1 && arguments[0] == "--help" ? 0 : 2;
        }
        Wearer wearer = new Wearer(arguments[1], arguments[2], arguments[3]);
        string robot = arguments[4];
        wearer.RunUntil(() => wearer.Words.Length > 0, 5);
        string words = wearer.Words;
        bool isJoined = wearer.RunUntil(() => wearer.Client != null && wearer.Client.View.IsSynced && wearer.Headset.Input != null);
        Write("join", isJoined, words, "robots", isJoined ? wearer.Client.View.Robots.Count : 0);
        if (!isJoined) return 1;
        Align(wearer);
        Draw(wearer);
        Acquire(wearer, robot);
        Move(wearer, robot, new Double3(0, 0, 0.1));
        wearer.Set("thumbstickClicked", 1f);
        Write("estop", wearer.RunUntil(() => wearer.Client.View.IsStopped, 10), wearer.Words, "errors", Engine.Errors.Count);
        UnityEngine.Object.Destroy(wearer.App.gameObject);
        SessionClient client = wearer.Client;
        Engine.Step();
        Write("leave", client.HasEnded && Engine.Errors.Count == 0, string.Join("; ", Engine.Errors), "errors", Engine.Errors.Count);
        return isAllDone ? 0 : 1;
    }

    /// <summary>Look at each sheet from one place after the other, as a person would, until the session has an alignment.</summary>
    private static void Align(Wearer wearer)
    {
        wearer.RunUntil(() => wearer.Words.Contains("sheet")); // panels have their texts some frames after the session is joined
        string words = wearer.Words;
        bool isAligned = false;
        for (int place = 0; place < MaxPlaces && !(isAligned && place > 2); place++)
        {
            double angle = 0.35 * place;
            foreach (AnchorInfo anchor in wearer.Client.View.Anchors.Values)
            {
                Double3 sheet = SceneDecoder.ToTransform(anchor.T_world_anchor).Position;
                wearer.Walk(sheet + new Double3(0.4 * Math.Cos(angle), 0.4 * Math.Sin(angle), 0.45), sheet);
                wearer.RunUntil(() => false, 0.6);
            }
            isAligned = wearer.Client.View.AlignmentState == AlignmentState.Aligned;
        }
        Write("align", isAligned, words, "true_mm", 1000 * wearer.MeasureAlignment());
    }

    private static void Draw(Wearer wearer)
    {
        WorldView world = wearer.World.World;
        bool isThere = wearer.RunUntil(() => world.Scene.Plan != null && wearer.App.Scene.Progress.IsComplete && world.Scene.IsComplete && !world.IsDimmed);
        double most = double.NaN;
        for (int row = 0; isThere && row < wearer.Client.View.Bodies.Length; row++)
        {
            Transform found = world.Scene.Bodies.Find(wearer.Client.View.Bodies[row].Id);
            if (found == world.World) continue;
            // x right, y up, z forward of x, y, z of the wire.
            Double3 at = RigidTransform.FromRow(wearer.Client.State.Poses, row).Position;
            float error = (found.position - world.World.TransformPoint(new Vector3((float)-at.Y, (float)at.Z, (float)at.X))).magnitude;
            if (!(error < most)) most = error;
        }
        Write("draw", isThere && Engine.Draws.Count > 0, wearer.World.Problem, "error_mm", 1000 * most, "draws", Engine.Draws.Count);
    }

    /// <summary>Point at the end effector, pull the trigger.</summary>
    private static void Acquire(Wearer wearer, string robot)
    {
        bool isOurs = wearer.TryGetSite(robot, out Double3 site);
        wearer.Point(site + new Double3(-0.3, 0, 0.35), site);
        string aimed = "";
        for (int attempt = 0; attempt < 3 && isOurs && !wearer.Client.View.IsOurs(robot); attempt++)
        {
            wearer.RunUntil(() => false, 0.3);
            aimed = wearer.Headset.Input.FindPointed(IrisSession.Interaction.Side.Right);
            wearer.Set("trigger", 1f);
            wearer.RunUntil(() => wearer.Client.View.IsOurs(robot), 5);
            wearer.Set("trigger", 0f);
        }
        Write("acquire", isOurs && wearer.Client.View.IsOurs(robot), aimed);
    }

    /// <summary>Close the clutch, again after a reason for which the session wants it opened, and move the hand.</summary>
    private static void Move(Wearer wearer, string robot, Double3 by)
    {
        bool isEngaged = false;
        string hold = "";
        for (int attempt = 0; attempt < 5 && !isEngaged; attempt++)
        {
            wearer.Set("grip", 0f);
            wearer.RunUntil(() => false, 0.5);
            wearer.Feedbacks.Remove(robot);
            wearer.Set("grip", 1f);
            isEngaged = wearer.RunUntil(() => wearer.Feedbacks.TryGetValue(robot, out Feedback now) && now.HoldReason.Length == 0, 3);
        }
        wearer.TryGetSite(robot, out Double3 before);
        wearer.Move(by);
        double error = double.NaN;
        wearer.RunUntil(() => wearer.TryGetSite(robot, out Double3 after) && (error = (after - before - by).Length) < 0.002, 6);
        if (wearer.Feedbacks.TryGetValue(robot, out Feedback last)) hold = last.HoldReason;
        wearer.Set("grip", 0f);
        Write("move", isEngaged && error < 0.005, hold, "error_mm", 1000 * error);
    }

    private static void Write(string what, bool isDone, string words, params object[] numbers)
    {
        isAllDone &= isDone;
        string line = "{\"command\": \"" + what + "\", \"ok\": " + (isDone ? "true" : "false") + ", \"words\": \"" + words.Replace('\\', ' ').Replace('"', '\'').Replace("\n", " ") + "\"";
        for (int i = 0; i + 1 < numbers.Length; i += 2)
        {
            double value = Convert.ToDouble(numbers[i + 1], CultureInfo.InvariantCulture);
            line += ", \"" + numbers[i] + "\": " + (double.IsNaN(value) ? "null" : value.ToString("0.###", CultureInfo.InvariantCulture));
        }
        Console.Out.WriteLine(line + "}");
        Console.Out.Flush();
    }
}
