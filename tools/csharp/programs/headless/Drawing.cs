using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Transport;
using IrisSession.Unity;
using Standins;
using UnityEngine;

/// <summary>The Unity layer on the stand-ins of the engine, in the frames of a headset.</summary>
internal sealed class Drawing
{
    private readonly Headset headset;
    private readonly IrisWorld component;

    public Drawing(Headset headset)
    {
        this.headset = headset;
        Engine.Reset();
        component = new GameObject("camera offset").AddComponent<IrisWorld>();
        component.Materials.Surface = new UnityEngine.Material(new Shader("surface"));
        component.Materials.Points = new UnityEngine.Material(new Shader("points"));
        component.Show(new SessionSource(headset.Client, headset.Scene));
    }

    /// <summary>Draw frames until everything of the scene is shown, and `condition` holds. Returns whether that was within a minute.</summary>
    public bool Run(Func<bool> condition)
    {
        return headset.RunUntil(() =>
        {
            Engine.Step(0.001 * Headset.FrameMs);
            WorldView world = component.World;
            return world == null || (headset.Scene.Progress.IsComplete && world.Scene.Plan != null && world.Scene.IsComplete && condition());
        });
    }

    public bool IsDimmed { get { return component.World.IsDimmed; } }

    /// <summary>Draw a frame and say what is in it.</summary>
    public bool Write(Report report, bool isDone)
    {
        WorldView world = component.World;
        isDone &= world != null && Engine.Errors.Count == 0;
        long vertices = 0;
        int people = 0;
        foreach (DrawCall call in Engine.Draws)
        {
            if (!(call.Mesh is null)) vertices += (long)call.Mesh.vertexCount * call.Matrices.Length;
            foreach (string id in headset.Client.View.Participants.Keys) if (call.Name.StartsWith(id + " ", StringComparison.Ordinal)) people++;
        }
        List<string> problems = new List<string> { component.Problem };
        if (world != null) problems.AddRange(world.Scene.Problems);
        foreach (Exception error in Engine.Errors) problems.Add(error.ToString());
        problems.RemoveAll(each => each.Length == 0);
        report.Write(
            "draw", isDone, "draws", Engine.Draws.Count, "vertices", vertices, "people", people, "points", world == null ? 0 : world.PointsDrawn, "dimmed", world != null && world.IsDimmed,
            "error_mm", world == null ? double.NaN : 1000.0 * MeasureError(world), "problems", problems.ToArray());
        return isDone;
    }

    /// <summary>Return how far a body is drawn from where the newest state has it, at most: x right, y up, z forward of x, y, z of the wire.</summary>
    private double MeasureError(WorldView world)
    {
        SessionView view = headset.Client.View;
        double most = 0.0;
        for (int row = 0; row < view.Bodies.Length; row++)
        {
            Transform found = world.Scene.Bodies.Find(view.Bodies[row].Id);
            if (found == world.World) continue;
            RigidTransform pose = RigidTransform.FromRow(headset.Client.State.Poses, row);
            Vector3 wanted = world.World.TransformPoint(new Vector3((float)-pose.Position.Y, (float)pose.Position.Z, (float)pose.Position.X));
            most = Math.Max(most, (found.position - wanted).magnitude);
        }
        return most;
    }
}
