// What `iris-session bench csharp` measures.
//
//     bench decode FRAMES OUT            decodes frames as an app does, and says how long that takes and what it allocates: one line of
//                                        JSON; decoded poses, vertices and points of every n-th frame are written to OUT
//     bench live ADDRESS NAME ORIGIN_NS  joins a session: see Live.cs
//
// FRAMES, little-endian: int32 bodies, frames, warm-up frames, n; int32 lengths with their bytes: welcome, snapshot and its keyframe,
// topology of the cloth; int32 number of clouds, each as its length and bytes: frame i has cloud i modulo that number. Then for each
// frame header, payload and presence of the state, and the cloth (0 bytes: it rests). At the end the topics of the state channel.
using System;
using System.Collections.Generic;
using System.Diagnostics;
using System.Globalization;
using System.IO;
using System.Text;
using IrisSession.Core;
using IrisSession.Protocol;

static class Bench
{
    static int Main(string[] arguments)
    {
        if (arguments.Length == 3 && arguments[0] == "decode") return Decode(arguments[1], arguments[2]);
        if (arguments.Length == 4 && arguments[0] == "live") return Live.Run(arguments[1], arguments[2], long.Parse(arguments[3], CultureInfo.InvariantCulture));
        Console.Error.WriteLine("bench decode FRAMES OUT | bench live ADDRESS NAME ORIGIN_NS");
        return 2;
    }

    static int Decode(string frames, string output)
    {
        var player = new FramePlayer(File.ReadAllBytes(frames));
        for (int i = 0; i < player.WarmUp; i++) player.Play(i);
        GC.Collect();
        long before = GC.GetAllocatedBytesForCurrentThread();
        for (int i = player.WarmUp; i < player.Frames; i++) player.Play(i);
        long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
        using (var file = File.Create(output)) player.WriteDecoded(file);
        var line = new StringBuilder("{");
        foreach (string name in new[] { "decode", "cloth", "cloud" })
        {
            double[] times = player.Times[name == "decode" ? 0 : name == "cloth" ? 1 : 2];
            Array.Sort(times);
            foreach (int percent in new[] { 50, 99 }) line.AppendFormat(CultureInfo.InvariantCulture, "\"{0}_us_p{1}\": {2:F2}, ", name, percent, times[times.Length * percent / 100]);
        }
        line.AppendFormat(CultureInfo.InvariantCulture, "\"frames\": {0}, \"allocated_bytes\": {1}", player.Frames - player.WarmUp, allocated);
        Console.WriteLine(line.Append('}'));
        return 0;
    }
}

/// <summary>Frames of a session, and everything that decodes them.</summary>
sealed class FramePlayer
{
    /// <summary>Period of frames, and the age with which they come [ns].</summary>
    const long PeriodNs = 16_666_667, AgeNs = 5_000_000;

    sealed class Memory : IIdentityStore
    {
        public byte[] Secret { get { return new byte[32]; } }
        public byte[] ResumeToken { get { return new byte[0]; } }
        public void Remember(byte[] token) { }
    }

    public readonly int Frames, WarmUp;

    /// <summary>Of state with presence, cloth and cloud [us], after the warm-up.</summary>
    public readonly double[][] Times = new double[3][];

    readonly byte[] data;
    readonly int every;
    readonly StateStream stream;
    readonly DeformableDecoder cloth;
    readonly int[] clouds;
    readonly int rigidTopic, presenceTopic;
    readonly List<Multipart> messages = new List<Multipart>();
    readonly Multipart rigid, presence;
    readonly PoseBuffer poses = new PoseBuffer();
    readonly VertexBuffer vertices = new VertexBuffer();
    readonly Cloud cloud = new Cloud();
    readonly double[] shown;
    readonly float[] shownVertices;
    readonly double[] keptPoses;
    readonly float[] keptVertices;
    int at, kept, devices;

    public FramePlayer(byte[] data)
    {
        this.data = data;
        int bodies = ReadInt();
        Frames = ReadInt();
        WarmUp = ReadInt();
        every = ReadInt();
        var connection = new ClientConnection(new Hello { Role = Role.Observer, Name = "bench" }, new Memory());
        connection.Open(0);
        connection.Receive(ReadMessage(1), 0);
        connection.Receive(ReadMessage(2), 0);
        stream = connection.Stream;
        if (stream.Poses == null) throw new InvalidDataException("the snapshot was not accepted");
        int length = ReadInt();
        cloth = new DeformableDecoder(new DeformableTopology(data, at, length), new Inflater());
        at += length;
        clouds = new int[ReadInt()];
        for (int i = 0; i < clouds.Length; i++)
        {
            clouds[i] = at;
            length = ReadInt();
            at += length;
        }
        rigidTopic = data.Length - Wire.TopicRigid.Length - Wire.TopicPresence.Length;
        presenceTopic = data.Length - Wire.TopicPresence.Length;
        rigid = new Multipart { Buffer = data };
        presence = new Multipart { Buffer = data };
        messages.Add(rigid);
        messages.Add(presence);
        for (int i = 0; i < Times.Length; i++) Times[i] = new double[Frames - WarmUp];
        shown = new double[7 * bodies];
        shownVertices = new float[cloth.Positions.Length];
        keptPoses = new double[(Frames / every + 1) * shown.Length];
        keptVertices = new float[(Frames / every + 1) * shownVertices.Length];
    }

    /// <summary>Decode and interpolate the next frame.</summary>
    public void Play(int frame)
    {
        long now = (frame + 1) * PeriodNs;
        long start = Stopwatch.GetTimestamp();
        PlayState(frame, now);
        long state = Stopwatch.GetTimestamp();
        PlayCloth(now);
        long clothed = Stopwatch.GetTimestamp();
        int from = clouds[frame % clouds.Length];
        cloud.Decode(data, from + 4, BitConverter.ToInt32(data, from));
        long end = Stopwatch.GetTimestamp();
        if (frame >= WarmUp)
        {
            Times[0][frame - WarmUp] = ToMicroseconds(state - start);
            Times[1][frame - WarmUp] = ToMicroseconds(clothed - state);
            Times[2][frame - WarmUp] = ToMicroseconds(end - clothed);
        }
        if (frame % every != 0) return;
        Array.Copy(stream.Poses, 0, keptPoses, kept * shown.Length, shown.Length);
        Array.Copy(cloth.Positions, 0, keptVertices, kept * shownVertices.Length, shownVertices.Length);
        kept++;
    }

    /// <summary>Write the poses and vertices that were kept, and the points of the last cloud.</summary>
    public void WriteDecoded(Stream file)
    {
        if (devices == 0) throw new InvalidDataException("no presence");
        Write(file, keptPoses, kept * shown.Length * sizeof(double));
        Write(file, keptVertices, kept * shownVertices.Length * sizeof(float));
        var points = new double[3 * cloud.Count];
        for (int i = 0; i < cloud.Count; i++)
        {
            Double3 point = cloud.GetPosition(i);
            points[3 * i] = point.X;
            points[3 * i + 1] = point.Y;
            points[3 * i + 2] = point.Z;
        }
        Write(file, points, points.Length * sizeof(double));
    }

    void PlayState(int frame, long now)
    {
        rigid.Clear();
        rigid.Add(rigidTopic, Wire.TopicRigid.Length);
        AddFrame(rigid);
        AddFrame(rigid);
        presence.Clear();
        presence.Add(presenceTopic, Wire.TopicPresence.Length);
        AddFrame(presence);
        if (!stream.Drain(messages, now + AgeNs, now + AgeNs)) throw new InvalidDataException("state frame " + frame + " was refused");
        poses.Add(stream.Header.SessionTime, stream.Poses);
        poses.TryGetPoses(now + AgeNs, shown, out _);
        devices += stream.Presence.ListItems().Count;
    }

    void PlayCloth(long now)
    {
        int length = ReadInt();
        if (length > 0) cloth.Decode(data, at, length);
        at += length;
        vertices.Add(now, cloth.Positions);
        vertices.TryGetVertices(now - PeriodNs / 2, shownVertices);
    }

    int ReadInt()
    {
        int value = BitConverter.ToInt32(data, at);
        at += 4;
        return value;
    }

    Multipart ReadMessage(int frames)
    {
        var message = new Multipart { Buffer = data };
        for (int i = 0; i < frames; i++) AddFrame(message);
        return message;
    }

    void AddFrame(Multipart message)
    {
        int length = ReadInt();
        message.Add(at, length);
        at += length;
    }

    static double ToMicroseconds(long ticks) { return 1e6 * ticks / Stopwatch.Frequency; }

    static void Write(Stream file, Array values, int bytes)
    {
        var buffer = new byte[bytes];
        Buffer.BlockCopy(values, 0, buffer, 0, bytes);
        file.Write(buffer, 0, bytes);
    }
}
