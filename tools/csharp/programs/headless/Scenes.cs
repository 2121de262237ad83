using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Transport;

/// <summary>
/// What is here of the scene: `scene` (waits until all of the one that the session names is here, and hashes it once more), `visual ID` (its
/// colour and place).
/// </summary>
internal sealed class Scenes
{
    private readonly Headset headset;
    private readonly Report report;
    private SceneUpdate newest;

    public Scenes(Headset headset, Report report)
    {
        this.headset = headset;
        this.report = report;
    }

    /// <summary>Wait for the scene and its assets, and hash all of them once more.</summary>
    public bool Wait()
    {
        SceneFetcher scene = headset.Scene;
        bool isComplete = headset.RunUntil(() =>
        {
            newest = scene.TakeUpdate() ?? newest;
            return scene.Progress.IsComplete && (scene.Progress.State != SceneState.Shown || newest?.SceneHash == headset.Client.View.SceneHash);
        }, 120.0);
        ScenePlan plan = newest?.Plan;
        int right = 0;
        long bytes = 0;
        int count = plan == null ? 0 : plan.Assets.Length;
        for (int i = 0; i < count; i++)
        {
            byte[] found = scene.Find(plan.Assets[i].Address);
            if (found == null || !AssetCache.HasAddress(found, 0, found.Length, plan.Assets[i].Address)) continue;
            right++;
            bytes += found.Length;
        }
        bool isDone = isComplete && right == count && scene.Crash.Length == 0;
        List<string> streams = new List<string>();
        if (plan != null) foreach (Deformable one in plan.Deformables) streams.Add(one.Stream);
        report.Write(
            "scene", isDone, "state", scene.Progress.State.ToString(), "hash", newest?.SceneHash, "assets", count, "equal", right, "bytes", bytes, "fetched", scene.FetchedCount, "fetched_bytes",
            scene.FetchedBytes, "failed", scene.Progress.FailedCount, "parts", plan == null ? 0 : plan.Parts.Length, "added_parts", newest == null ? 0 : newest.Changes.AddedParts.Count,
            "removed_parts", newest == null ? 0 : newest.Changes.RemovedParts.Count, "deformables", streams.ToArray(), "text", scene.Progress.Text, "crash", scene.Crash);
        return isDone;
    }

    /// <summary>Write how a visual looks, and where it is on its body.</summary>
    public bool ShowVisual(long id)
    {
        foreach (ScenePart part in newest == null ? new ScenePart[0] : newest.Plan.Parts)
        {
            foreach (SceneShape shape in part.Shapes)
            {
                if (shape.Visual != id) continue;
                Double3 place = (part.Places[0].T_body_part * shape.T_part_shape).Position;
                report.Write("visual", true, "id", id, "kind", shape.Geometry.Kind, "rgba", part.Look.Rgba, "body", part.Places[0].Body, "position", new[] { place.X, place.Y, place.Z });
                return true;
            }
        }
        report.Write("visual", false, "id", id);
        return false;
    }

    /// <summary>Return a decoder for a stream of the scene, null when it is no deformable of it.</summary>
    public DeformableDecoder MakeDecoder(string stream)
    {
        if (newest == null) return null;
        foreach (Deformable deformable in newest.Plan.Deformables)
        {
            byte[] bytes = deformable.Stream == stream ? headset.Scene.Find(deformable.Address) : null;
            if (bytes == null) continue;
            byte[] topology = new ArrayDecoder().Decode(bytes).RequireBytes(ArrayName.Plan, ArrayAsset.Any);
            return new DeformableDecoder(new DeformableTopology(topology, 0, topology.Length), new Inflater());
        }
        return null;
    }
}
