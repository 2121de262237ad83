// A scene and frames of the Python server (tools/csharp/unity_scenes.py) as the source of a world, and what is drawn of it.
using System;
using System.Collections.Generic;
using System.Diagnostics;
using System.Globalization;
using System.IO;
using System.Linq;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;
using NUnit.Framework;
using Standins;
using UnityEngine;

namespace IrisSession.Unity.StandinTests
{
    /// <summary>Brings the lines of `frames` one after the other.</summary>
    internal sealed class RecordedScene : IWorldSource
    {
        public readonly List<double[]> Probes = new List<double[]>();
        public readonly List<double[]> Vertices = new List<double[]>();
        public readonly List<double[]> Points = new List<double[]>();
        public readonly Dictionary<long, double[]> Bodies = new Dictionary<long, double[]>();
        public readonly Dictionary<string, ParticipantInfo> People = new Dictionary<string, ParticipantInfo>();
        public ScenePlan Plan;
        public long NewestNs;

        /// <summary>Assets that are here; all of them unless a test takes some away.</summary>
        public volatile HashSet<string> Hidden = new HashSet<string>();

        /// <summary>Assets whose bytes are wrong.</summary>
        public volatile HashSet<string> Damaged = new HashSet<string>();

        /// <summary>Assets that make those throw who want them.</summary>
        public volatile HashSet<string> Broken = new HashSet<string>();

        /// <summary>Thrown by the next update.</summary>
        public Exception Error;
        private readonly string folder;
        private readonly Queue<string[]> lines;
        private readonly RigidDecoder decoder;
        private readonly BodyInfo[] bodies;
        private ScenePlan shown;

        public RecordedScene(string name)
        {
            string vectors = System.Environment.GetEnvironmentVariable("IRIS_VECTORS");
            if (vectors == null) Assert.Ignore("the scenes are written by python -m tools.csharp test");
            folder = Path.Combine(vectors, "unity", name);
            Plan = new ScenePlan(ReadSpec(), DrawBudget.Quest3.Scene);
            lines = new Queue<string[]>(File.ReadLines(Path.Combine(folder, "frames")).Select(line => line.Split('\t')));
            bodies = lines.Where(line => line[0] == "body").Select(line => long.Parse(line[1])).Distinct().Select(id => new BodyInfo { Id = id }).ToArray();
            decoder = new RigidDecoder(bodies.Length);
        }

        public long SessionNowNs { get; set; }

        public IReadOnlyDictionary<string, ParticipantInfo> Participants { get { return People; } }

        public byte[] Find(string address)
        {
            if (Hidden.Contains(address)) return null;
            if (Broken.Contains(address)) throw new InvalidOperationException("broken");
            return Damaged.Contains(address) ? new byte[100] : File.ReadAllBytes(Path.Combine(folder, "assets", address));
        }

        public void Update(WorldView world)
        {
            if (Error != null) throw Error;
            if (shown == Plan) return;
            world.Scene.Apply(Plan, new SceneChanges(shown, Plan));
            shown = Plan;
        }

        /// <summary>Bring lines until `states` more states have come and the lines of the last one are read.</summary>
        public void Play(WorldView world, int states)
        {
            while (lines.Count > 0 && (lines.Peek()[0] != "state" || states-- > 0)) Bring(world, lines.Dequeue());
        }

        /// <summary>Return the specification of this scene once more, to be changed.</summary>
        public SceneSpec ReadSpec()
        {
            byte[] spec = File.ReadAllBytes(Path.Combine(folder, "scene"));
            return SceneDecoder.Decode(spec, 0, spec.Length);
        }

        private void Bring(WorldView world, string[] line)
        {
            switch (line[0])
            {
                case "state":
                    Probes.Clear();
                    byte[] payload = FromHex(line[3]);
                    Assert.IsTrue(decoder.Apply(long.Parse(line[1]), long.Parse(line[2]), payload, 0, payload.Length));
                    NewestNs = long.Parse(line[5]);
                    world.Poses.Add(NewestNs, long.Parse(line[4]), decoder.Poses, bodies);
                    break;
                case "body":
                    Bodies[long.Parse(line[1])] = Numbers(line[2]);
                    break;
                case "media":
                    byte[] header = FromHex(line[1]), bytes = FromHex(line[2]);
                    Multipart message = new Multipart { Buffer = header.Concat(bytes).ToArray() };
                    message.Add(0, 0);
                    message.Add(0, header.Length);
                    message.Add(header.Length, bytes.Length);
                    world.Media.Process(message);
                    break;
                default:
                    (line[0] == "probe" ? Probes : line[0] == "vertex" ? Vertices : Points).Add(Numbers(line[1]));
                    break;
            }
        }

        private static double[] Numbers(string text) { return text.Split(' ').Select(each => double.Parse(each, CultureInfo.InvariantCulture)).ToArray(); }

        private static byte[] FromHex(string digits)
        {
            byte[] bytes = new byte[digits.Length / 2];
            for (int i = 0; i < bytes.Length; i++) bytes[i] = byte.Parse(digits.Substring(2 * i, 2), NumberStyles.HexNumber);
            return bytes;
        }
    }

    /// <summary>A scene in an engine.</summary>
    internal sealed class Stage
    {
        private const double LimitS = 60.0;
        public readonly IrisWorld Component;
        public readonly RecordedScene Source;
        public readonly GameObject Tracking;

        public Stage(string scene)
        {
            Engine.Reset();
            Source = new RecordedScene(scene);
            Tracking = new GameObject("camera offset");
            Tracking.transform.SetPositionAndRotation(new Vector3(0.5f, -0.2f, 1f), Quaternion.AngleAxis(30f, Vector3.up));
            Component = Tracking.AddComponent<IrisWorld>();
            Component.Materials.Surface = new UnityEngine.Material(new Shader("surface"));
            Component.Materials.Points = new UnityEngine.Material(new Shader("points"));
            Component.Show(Source);
        }

        public WorldView World { get { return Component.World; } }

        /// <summary>Run frames until everything is loaded whose assets are here.</summary>
        public void Load()
        {
            Stopwatch watch = Stopwatch.StartNew();
            do
            {
                Engine.Step();
                Thread.Yield();
                Assert.Less(watch.Elapsed.TotalSeconds, LimitS);
            }
            while (!World.Scene.IsSettled);
            Engine.Step();
            CheckNoErrors();
        }

        /// <summary>Bring states, and draw when they are shown: the newest one exactly.</summary>
        public void Show(int states)
        {
            Source.Play(World, states);
            Source.SessionNowNs = Source.NewestNs + World.Poses.Buffer.DelayNs;
            Engine.Step();
            CheckNoErrors();
        }

        public void CheckNoErrors()
        {
            CollectionAssert.IsEmpty(Engine.Errors);
            CollectionAssert.IsEmpty(World.Scene.Problems);
        }

        /// <summary>A point of the world, in the axes of the wire, where the engine must have it: x right, y up, z forward.</summary>
        public Vector3 Expect(double x, double y, double z)
        {
            return World.World.localToWorldMatrix.MultiplyPoint3x4(new Vector3((float)-y, (float)z, (float)x));
        }

        /// <summary>Every vertex that is drawn by a mesh, in the world of the engine.</summary>
        public static Vector3[] ListDrawn()
        {
            List<Vector3> drawn = new List<Vector3>();
            foreach (DrawCall call in Engine.Draws)
            {
                if (call.Mesh is null) continue;
                Vector3[] vertices = call.Mesh.vertices;
                foreach (Matrix4x4 matrix in call.Matrices) foreach (Vector3 vertex in vertices) drawn.Add(matrix.MultiplyPoint3x4(vertex));
            }
            return drawn.ToArray();
        }

        /// <summary>Fail unless a vertex is drawn at each place.</summary>
        public static void AssertDrawn(Vector3[] drawn, Vector3 wanted, float toleranceM)
        {
            float best = float.MaxValue;
            foreach (Vector3 one in drawn)
            {
                float x = one.x - wanted.x, y = one.y - wanted.y, z = one.z - wanted.z;
                best = Math.Min(best, x * x + y * y + z * z);
            }
            Assert.LessOrEqual(Math.Sqrt(best), toleranceM, "nothing is drawn at " + wanted);
        }
    }
}
