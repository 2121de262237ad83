// An app on the stand-ins of the engine: its files, its wearer's hands and what the wearer reads.
using System;
using System.Diagnostics;
using System.IO;
using System.Net;
using System.Net.Sockets;
using System.Threading;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Transport;
using IrisSession.Unity.App;
using IrisSession.Unity.ArFoundation;
using IrisSession.Unity.Input;
using NUnit.Framework;
using Standins;
using Unity.XR.CoreUtils;
using UnityEngine;
using UnityEngine.Android;
using UnityEngine.XR.ARFoundation;
using UnityEngine.XR.ARSubsystems;

namespace IrisSession.Unity.StandinTests
{
    /// <summary>One app with an identity of its own. Dispose of it to destroy it.</summary>
    internal sealed class AppStage : IDisposable
    {
        private const double LimitS = 60.0;
        private static readonly Vector3 Eyes = new Vector3(0f, 1.6f, 0f);
        public readonly GameObject Offset;
        public readonly IrisApp App;
        public readonly IrisHeadset Headset;
        public readonly XROrigin Origin;
        private readonly Socket beacons = new Socket(AddressFamily.InterNetwork, SocketType.Dgram, ProtocolType.Udp);
        private readonly string folder = Path.Combine(Path.GetTempPath(), "iris-app-" + Guid.NewGuid().ToString("N"));

        /// <param name="isQuest">With the component of a Quest, whose system reads codes.</param>
        /// <param name="set">Changes what the app looks for.</param>
        public AppStage(bool isQuest, Action<ConnectorSettings> set = null)
        {
            Engine.Reset();
            Controls.Clear();
            Subsystems.Running.Clear();
            Subsystems.Loaded.Clear();
            Permission.Granted.Clear();
            Permission.Requested.Clear();
            JavaCalls.All.Clear();
            TouchScreenKeyboard.IsThere = false;
            Application.Platform = isQuest ? RuntimePlatform.Android : RuntimePlatform.LinuxPlayer;
            Application.PersistentDataPath = folder;
            Directory.CreateDirectory(folder);
            SetPose("<XRHMD>/", "centerEyePosition", "centerEyeRotation", Eyes, Quaternion.identity);
            Offset = new GameObject("camera offset");
            App = Offset.AddComponent<IrisApp>();
            Headset = Offset.GetComponent<IrisHeadset>();
            IrisMaterials materials = Offset.GetComponent<IrisWorld>().Materials;
            materials.Surface = new Material(new Shader("surface"));
            materials.Points = new Material(new Shader("points"));
            Origin = new GameObject("origin").AddComponent<XROrigin>();
            Origin.Trackables = new GameObject("trackables").transform;
            if (isQuest)
            {
                Subsystems.Loaded.Add(XRMarkerSubsystem.Make(XRMarkerType.QRCode));
                ARMarkerManager manager = Origin.gameObject.AddComponent<ARMarkerManager>();
                manager.enabled = false;
                Offset.AddComponent<IrisQuest>().SetUp(Origin, manager, null);
            }
            BeaconPort = FindFreePort();
            App.Configuring += settings =>
            {
                settings.BeaconPort = BeaconPort;
                settings.SilenceNs = 0;
                settings.AgainMs = 10;
                settings.UsesThisMachine = true;
                set?.Invoke(settings);
            };
        }

        public int BeaconPort { get; }

        /// <summary>What the panel before a session says.</summary>
        public string Text { get { return App.Panel.Text; } }

        /// <summary>What stands before the eyes in a session.</summary>
        public string Urgent { get { return Headset.Panels == null ? "" : Headset.Panels.Urgent.Text; } }

        public static void SetPose(string device, string position, string rotation, Vector3 at, Quaternion turn)
        {
            Controls.Set(device + position, at);
            Controls.Set(device + rotation, turn);
            Controls.Set(device + "isTracked", 1f);
            Controls.Set(device + "trackingState", 3);
        }

        public void WriteFile(string name, string text) { File.WriteAllText(Path.Combine(folder, name), text); }

        /// <summary>Run frames until a condition holds.</summary>
        public void StepUntil(Func<bool> condition, string what)
        {
            Stopwatch watch = Stopwatch.StartNew();
            while (!condition())
            {
                Assert.Less(watch.Elapsed.TotalSeconds, LimitS, what + "; the panel says: " + Text + Urgent);
                Engine.Step();
                Thread.Sleep(1);
            }
        }

        /// <summary>Announce a session once.</summary>
        /// <returns>True, so that it can be in a condition.</returns>
        public bool Announce(string name, GatewaySession session)
        {
            byte[] beacon = new Protocol.Beacon { Protocol = Protocol.Wire.Version, SessionId = name, SessionName = name, Host = "127.0.0.1", Control = 7721, Web = session.Port, Kind = "sim", KeyFingerprint = session.IsSecure ? "ab" : "" }.Encode();
            beacons.SendTo(beacon, new IPEndPoint(IPAddress.Loopback, BeaconPort));
            return true;
        }

        public void WaitFor(ConnectorPhase phase) { StepUntil(() => App.View != null && App.View.Phase == phase, phase.ToString()); }

        /// <summary>Point at a button of the panel and press the trigger, until a condition holds.</summary>
        public void Press(string button, Func<bool> condition, string what)
        {
            bool isDown = false;
            StepUntil(
                () =>
                {
                    Panel found = Find(button);
                    if (found != null) SetPose("<XRController>{RightHand}/", "devicePosition", "deviceRotation", EnginePoses.ToEngine(found.At) - Vector3.forward, Quaternion.identity);
                    if (found != null) SetPose("<XRController>{RightHand}/pointer/", "position", "rotation", EnginePoses.ToEngine(found.At) - Vector3.forward, Quaternion.identity); // ahead, as the eyes
                    isDown = found != null && !isDown;
                    Controls.Set("<XRController>{RightHand}/trigger", isDown ? 1f : 0f);
                    return condition();
                },
                what);
            Controls.Set("<XRController>{RightHand}/trigger", 0f);
        }

        public void Dispose()
        {
            beacons.Dispose();
            UnityEngine.Object.Destroy(Offset);
            Engine.Step();
            Application.Platform = RuntimePlatform.LinuxPlayer;
            CollectionAssert.IsEmpty(Engine.Errors);
            Directory.Delete(folder, true);
        }

        /// <summary>Show a code 0.6 m ahead.</summary>
        public ARMarker ShowCode(string text)
        {
            ARMarker marker = new GameObject("marker").AddComponent<ARMarker>();
            marker.transform.SetParent(Origin.Trackables, false);
            marker.transform.SetPositionAndRotation(new Vector3(0f, 1.5f, 0.6f), Quaternion.AngleAxis(-90f, Vector3.right));
            marker.size = new Vector2(0.15f, 0.15f);
            marker.Data = text;
            return marker;
        }

        public static int FindFreePort()
        {
            using (Socket free = new Socket(AddressFamily.InterNetwork, SocketType.Dgram, ProtocolType.Udp))
            {
                free.Bind(new IPEndPoint(IPAddress.Loopback, 0));
                return ((IPEndPoint)free.LocalEndPoint).Port;
            }
        }

        private Panel Find(string text)
        {
            foreach (Panel one in App.Panel.All) if ((one.Style == PanelStyle.Button || one.Style == PanelStyle.AimedButton) && one.Text.StartsWith(text, StringComparison.Ordinal)) return one;
            return null;
        }
    }
}
