// The component that makes an app of the layers: put it on the camera offset of an XR origin, with IrisWorld and IrisHeadset, and beside it
// the component of the headset, such as IrisQuest. It finds a session, joins it, shows it, and says before the eyes what is wrong.
using System;
using System.IO;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Protocol;
using IrisSession.Storage;
using IrisSession.Transport;
using IrisSession.Unity.Input;
using UnityEngine;

namespace IrisSession.Unity.App
{
    /// <summary>A headset app. Before the components that it feeds, so that nothing is a frame late. Nothing is thrown to the engine.</summary>
    [DefaultExecutionOrder(40)]
    [RequireComponent(typeof(IrisHeadset))]
    [RequireComponent(typeof(IrisWorld))]
    public sealed class IrisApp : MonoBehaviour
    {
        private const int MaxFileBytes = 1 << 20;

        [SerializeField] private string participantName = "";
        [SerializeField] private string address = "";
        [SerializeField] private string sessionName = "";
        [SerializeField] private bool useCable = true;

        private readonly MulticastLock multicast = new MulticastLock();
        private readonly TextKeyboard keyboard = new TextKeyboard();
        private StartAction typed;
        private IHeadsetKind kind;
        private IrisHeadset headset;
        private IrisWorld world;
        private SessionConnector connector;
        private SessionClient client;
        private string notice = "";
        private string said = "";
        private string entered = ""; // typed or scanned: in place of what was given

        /// <summary>Name that others see; empty: that of the device. Set it before the first frame, as the others here.</summary>
        public string ParticipantName { get { return participantName; } set { participantName = value; } }

        /// <summary>Address or link; empty: the file of `iris-session pair --unity`, or sessions that announce themselves.</summary>
        public string Address { get { return address; } set { address = value; } }

        /// <summary>The only session that is wanted of those that announce themselves; empty: any.</summary>
        public string SessionName { get { return sessionName; } set { sessionName = value; } }

        /// <summary>Use a cable to the computer of the session (`adb reverse`) where there is one.</summary>
        public bool UseCable { get { return useCable; } set { useCable = value; } }

        /// <summary>Called before a search begins, for what has no field here: the role, capabilities.</summary>
        public event Action<ConnectorSettings> Configuring;

        /// <summary>What is found and what is wrong.</summary>
        public ConnectorView View { get { return connector == null ? null : connector.View; } }

        /// <summary>The session, null while there is none.</summary>
        public SessionClient Client { get { return client; } }

        /// <summary>Its scene, null with it.</summary>
        public SceneFetcher Scene { get { return connector == null ? null : connector.Scene; } }

        /// <summary>What the wearer sees while there is no session.</summary>
        public StartPanel Panel { get; } = new StartPanel();

        /// <summary>A defect that has ended the app, or a file that cannot be used; for people, empty while all is well.</summary>
        public string Problem { get; private set; } = "";

        private void Start()
        {
            try
            {
                headset = GetComponent<IrisHeadset>();
                headset.StartPanel = Panel;
                world = GetComponent<IrisWorld>();
                kind = GetComponent<IHeadsetKind>();
                kind?.Prepare(headset);
                world.Draws = kind == null ? DrawBudget.Quest3 : kind.Draws;
                headset.RobotPanels = world.Draws.RobotPanels;
                Panel.Markers = headset.MarkerSource;
                Panel.CanType = TextKeyboard.IsSupported;
                Open();
            }
            catch (Exception error)
            {
                End(error);
            }
        }

        private void Open()
        {
            connector = new SessionConnector(MakeSettings());
            connector.Start();
        }

        private void Update()
        {
            if (connector == null) return;
            try
            {
                Poll();
            }
            catch (Exception error)
            {
                End(error);
            }
        }

        private void Poll()
        {
            connector.Poll();
            ConnectorView view = connector.View;
            if (!ReferenceEquals(connector.Client, client)) Follow(connector.Client, connector.Scene);
            if (headset.Input == null) world.Ghosts = null; // of a hand that is not read any more
            multicast.Hold(view.Phase == ConnectorPhase.Searching || view.Phase == ConnectorPhase.Choosing);
            Panel.Show(view);
            Panel.Notice = Problem.Length > 0 ? Problem : headset.Problem.Length > 0 ? headset.Problem : notice;
            if (world.Problem != said) headset.Notice = said = world.Problem;
            Do(Panel.TakeAction());
            TakeText();
        }

        /// <summary>Show a session, or none any more.</summary>
        private void Follow(SessionClient joined, SceneFetcher scene)
        {
            client = joined;
            world.Ghosts = null;
            world.Show(joined == null ? null : new SessionSource(joined, scene));
            headset.Connect(joined, joined == null ? null : new WorldBodies(world));
            if (joined == null) return;
            notice = "";
            if (world.Draws.HasGhosts) world.Ghosts = new HandGhosts(headset.Input, new SessionClientPort(joined));
            kind?.OnConnected(headset);
        }

        private void Do(StartAction action)
        {
            switch (action)
            {
                case StartAction.Choose:
                    connector.Choose(Panel.Chosen);
                    break;
                case StartAction.Enter:
                    Enter(Panel.Scanned);
                    break;
                case StartAction.Search:
                    Enter("");
                    break;
                case StartAction.Trust:
                    connector.Trust();
                    break;
                case StartAction.Retry:
                    connector.Retry();
                    break;
                case StartAction.TypeAddress:
                case StartAction.TypeCode:
                    typed = action;
                    keyboard.Open(action == StartAction.TypeCode ? "7KQ2-M4XD-9PTR" : "192.168.0.10");
                    break;
                default:
                    return;
            }
            notice = "";
        }

        private void TakeText()
        {
            string text = keyboard.TakeText();
            if (text == null) return;
            if (typed == StartAction.TypeCode) connector.EnterCode(text);
            else Enter(text);
        }

        private void Enter(string text)
        {
            entered = text;
            connector.Enter(text);
        }

        private ConnectorSettings MakeSettings()
        {
            string folder = Application.persistentDataPath;
            RuntimePlatform platform = Application.platform;
            string name = participantName.Length > 0 ? participantName : SystemInfo.deviceName;
            ConnectorSettings settings = new ConnectorSettings
            {
                Name = name,
                Software = "iris-session " + Application.version,
                Devices = kind == null ? new[] { Device.Head, Device.ControllerLeft, Device.ControllerRight } : kind.Devices,
                Identity = new FileIdentityStore(Path.Combine(folder, "identity")),
                Cache = new AssetCache(new DiskAssetFiles(Path.Combine(folder, "assets"))),
                Budget = world.Draws.Scene,
                PairingFile = entered.Length > 0 ? null : ReadPairingFile(Path.Combine(folder, PairingFile.Name)),
                Address = entered.Length > 0 ? entered : address,
                SessionName = sessionName,
                UsesCable = useCable,
                UsesThisMachine = platform != RuntimePlatform.Android && platform != RuntimePlatform.WSAPlayerARM && platform != RuntimePlatform.WSAPlayerX64,
            };
            string problem = settings.Identity.Problem;
            if (problem.Length > 0) notice = "This headset cannot keep its identity, and has to be paired anew at each start: " + problem;
            Configuring?.Invoke(settings);
            return settings;
        }

        /// <summary>Return the text of the file of `iris-session pair --unity`, null for none.</summary>
        private string ReadPairingFile(string path)
        {
            try
            {
                FileInfo file = new FileInfo(path);
                if (!file.Exists) return null;
                if (file.Length <= MaxFileBytes) return File.ReadAllText(path);
                notice = PairingFile.Name + " has " + file.Length + " bytes: it is no file of iris-session pair --unity";
            }
            catch (Exception error) when (error is IOException || error is UnauthorizedAccessException)
            {
                notice = PairingFile.Name + " cannot be read: " + error.Message;
            }
            return null;
        }

        /// <summary>A defect: it is said once, the session is left, so that robots hold, and the application goes on.</summary>
        private void End(Exception error)
        {
            Debug.LogException(error);
            Problem = "This app has a defect and left the session: start it again. " + error.Message;
            Panel.Notice = Problem;
            TryClose();
        }

        /// <summary>Leave the session, within about a second, whatever else fails: nothing would drive it any more.</summary>
        private void Close()
        {
            SessionConnector ended = connector;
            connector = null;
            client = null;
            Panel.Show(ConnectorView.Idle);
            try
            {
                multicast.Hold(false);
                if (headset != null) headset.Connect(null, null);
                if (world == null) return;
                world.Ghosts = null;
                world.Show(null);
            }
            finally
            {
                ended?.Stop();
            }
        }

        private void TryClose()
        {
            try
            {
                Close();
            }
            catch (Exception error)
            {
                Debug.LogException(error);
            }
        }

        /// <summary>In the background nothing is searched for or joined; a session that was joined is kept, in which robots hold (IrisHeadset reports it).</summary>
        private void OnApplicationPause(bool pauseStatus)
        {
            bool isKept = client != null || (connector != null && connector.View.Phase == ConnectorPhase.Pairing); // its code works once: the answer is waited for
            connector?.SetPaused(pauseStatus);
            if (isKept || headset == null || Problem.Length > 0) return;
            try
            {
                if (pauseStatus) Close();
                else if (connector == null) Open();
            }
            catch (Exception error)
            {
                End(error);
            }
        }

        private void OnDestroy() { TryClose(); }
    }
}
