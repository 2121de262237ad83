using System;
using System.Collections.Generic;
using System.IO;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Transport;

/// <summary>
/// Streams as they arrive: `follow STATES FILE` (poses of the bodies), `media STREAM FRAMES FILE` (vertices of a cloth, points of a cloud;
/// of pictures nothing but that they came). A frame in FILE is: its tick or, of media, when it was captured [ns] (int64), how many numbers
/// follow (int32), and these (float64).
/// </summary>
internal sealed class Streams
{
    private const double WaitS = 120.0;

    private readonly Headset headset;
    private readonly Report report;
    private readonly Scenes scenes;

    public Streams(Headset headset, Report report, Scenes scenes)
    {
        this.headset = headset;
        this.report = report;
        this.scenes = scenes;
    }

    private SessionClient Client { get { return headset.Client; } }

    /// <summary>Write so many states.</summary>
    public bool Follow(int count, string path)
    {
        BodyInfo[] bodies = Client.View.Bodies;
        long version = Client.View.BodiesVersion;
        long beganNs = 0;
        int states = 0;
        long newest = Client.State.Tick;
        StateFrame state = Client.State;
        bool isDone;
        using (BinaryWriter file = new BinaryWriter(File.Create(path)))
        {
            isDone = headset.RunUntil(() =>
            {
                state = Client.State;
                if (state.Tick == newest || state.BodiesVersion != version) return false;
                newest = state.Tick;
                if (states++ == 0) beganNs = state.SessionTimeNs;
                WriteFrame(file, state.Tick, state.Poses);
                return states >= count;
            }, WaitS);
        }
        report.Write(
            "follow", isDone, "states", states, "seconds", (state.SessionTimeNs - beganNs) * 1e-9, "bodies", Array.ConvertAll(bodies, each => each.Name));
        return isDone;
    }

    /// <summary>Write so many frames of a stream.</summary>
    public bool Receive(string stream, int count, string path)
    {
        Client.TryPost(loop => loop.SetMediaWishes(new[] { stream }));
        MediaHeader header = new MediaHeader();
        WireReader reader = new WireReader();
        Multipart message = new Multipart();
        Cloud cloud = new Cloud();
        DeformableDecoder cloth = scenes.MakeDecoder(stream);
        List<double> numbers = new List<double>();
        int frames = 0;
        MediaHeader first = new MediaHeader();
        long replaced = Client.MediaReplaced; // before the first frame: one that came after it may be replaced at once
        long points = 0;
        bool isDone;
        using (BinaryWriter file = new BinaryWriter(File.Create(path)))
        {
            isDone = headset.RunUntil(() =>
            {
                while (frames < count && Client.TryTakeMedia(ref message))
                {
                    reader.Reset(message.Buffer, message.OffsetOf(1), message.LengthOf(1));
                    reader.ReadInto(header);
                    if (header.Stream != stream) continue; // of the command before
                    numbers.Clear();
                    if (header.Encoding == MediaEncoding.Cloud)
                    {
                        cloud.Decode(message.Buffer, message.OffsetOf(2), message.LengthOf(2));
                        for (int i = 0; i < cloud.Count; i++)
                        {
                            Double3 place = cloud.GetPosition(i);
                            numbers.Add(place.X);
                            numbers.Add(place.Y);
                            numbers.Add(place.Z);
                        }
                    }
                    else if (header.Encoding == MediaEncoding.Deformable && cloth != null)
                    {
                        cloth.Decode(message.Buffer, message.OffsetOf(2), message.LengthOf(2));
                        foreach (float one in cloth.Positions) numbers.Add(one);
                    }
                    points = numbers.Count / 3;
                    if (frames++ == 0)
                    {
                        reader.Reset(message.Buffer, message.OffsetOf(1), message.LengthOf(1));
                        reader.ReadInto(first);
                    }
                    WriteFrame(file, header.CaptureNs, numbers.ToArray());
                }
                return frames >= count;
            }, WaitS);
        }
        Client.TryPost(loop => loop.SetMediaWishes(new string[0]));
        double seconds = (header.CaptureNs - first.CaptureNs) * 1e-9;
        report.Write(
            "media", isDone, "stream", stream, "encoding", header.Encoding, "frames", frames, "seconds", seconds, "hz", (frames - 1) / seconds, "points", points, "class", header.BudgetClass, "published",
            header.Seq - first.Seq + 1, "dropped", header.Dropped - first.Dropped, "replaced", Client.MediaReplaced - replaced);
        return isDone;
    }

    private static void WriteFrame(BinaryWriter file, long key, double[] numbers)
    {
        file.Write(key);
        file.Write(numbers.Length);
        byte[] bytes = new byte[8 * numbers.Length];
        Buffer.BlockCopy(numbers, 0, bytes, 0, bytes.Length);
        file.Write(bytes);
    }
}
