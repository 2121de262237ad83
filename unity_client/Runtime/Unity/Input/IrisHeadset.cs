// The component that reads a headset: put it on the object in whose frame the headset tracks, beside IrisWorld.
//
//     without a session     the panel from which one is joined
//     with a session        devices, samples, requests, panels
//     after a defect        the e-stop alone, and words
using System;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Transport;
using UnityEngine;

namespace IrisSession.Unity.Input
{
    /// <summary>Reads devices, sends what they mean, and shows panels. Before what is drawn, so that nothing is a frame late.</summary>
    [DefaultExecutionOrder(50)]
    public sealed class IrisHeadset : MonoBehaviour
    {
        private const double ConditionS = 1.0;
        private const string AfterDefect = ". Robots hold. To stop them press the stick of a controller, or the button here; if neither answers, use the stop of the robots themselves";

        [SerializeField] private Material rayMaterial = null;
        private readonly DeviceCondition condition = new DeviceCondition();
        private readonly HeadsetReading ownReading = new HeadsetReading(); // while there is no input
        private readonly PermissionState[] permissions = new PermissionState[3]; // by HeadsetPermission
        private ControlReader reader;
        private ControllerHaptics haptics;
        private SessionClient client;
        private SessionClientPort port;
        private PanelViews views;
        private PanelViews startViews;
        private StopInput stops;
        private double conditionAt;
        private bool isPaused;
        private bool hasFocus = true;
        private bool wasOnHead = true;
        private bool wasTracking = true;
        private bool hadMarkers = true;
        private AppFocus focus = AppFocus.Focused;

        /// <summary>What the devices mean, null without a session. Commands of the application: `Input.Buttons.AddCommand`.</summary>
        public HeadsetInput Input { get; private set; }

        public HeadsetPanels Panels { get; private set; }

        /// <summary>Codes; set before <see cref="Connect"/>. Null: none are looked for.</summary>
        public IMarkerSource MarkerSource { get; set; }

        /// <summary>Bare hands; set before <see cref="Connect"/>. Null: none.</summary>
        public IHands BareHands { get; set; }

        /// <summary>Names of the controls; set before <see cref="Connect"/>.</summary>
        public ControlNames Controls { get; set; } = ControlNames.Controllers;

        /// <summary>What the devices of the controls are.</summary>
        public InputKind ControlsKind { get; set; } = InputKind.Controller;

        /// <summary>For hands that have one gesture: see <see cref="AirTap"/>. Set before <see cref="Connect"/>; null: trigger and squeeze are two.</summary>
        public AirTap Taps { get; set; }

        /// <summary>The panel that is shown while there is no session; null: none.</summary>
        public StartPanel StartPanel { get; set; }

        /// <summary>Panels of robots; set before <see cref="Connect"/>.</summary>
        public int RobotPanels { get; set; } = HeadsetPanels.MaxRobots;

        public DeviceCondition Condition { get { return condition; } }

        /// <summary>Words of the application before the eyes, empty for none.</summary>
        public string Notice { get; set; } = "";

        /// <summary>Everything that the session says, after the input has taken it.</summary>
        public event Action<SessionNews> News;

        /// <summary>Why there is no input, for people; empty while all is well.</summary>
        public string Problem { get; private set; } = "";

        /// <summary>Drive a session; null: none any more. `bodies`: as they are shown. Words about the rest come from the client.</summary>
        public void Connect(SessionClient client, IBodies bodies)
        {
            this.client = client;
            Problem = "";
            Input = null;
            stops = null;
            RemovePanels();
            if (StartPanel != null) StartPanel.Session = null;
            if (client == null) return;
            StartPanel?.Hide();
            wasOnHead = wasTracking = hadMarkers = true; // as a new client takes it; the next frame reports what differs
            if (focus != AppFocus.Focused) ReportFocus(focus);
            for (int i = 0; i < permissions.Length; i++) if (permissions[i] != PermissionState.Unknown) ReportPermission((HeadsetPermission)i, permissions[i] == PermissionState.Granted);
            if (haptics == null) haptics = new ControllerHaptics();
            port = new SessionClientPort(client);
            Input = new HeadsetInput(port, bodies, haptics) { Markers = MarkerSource == null ? null : new MarkerLooks(MarkerSource) };
            if (StartPanel != null) Input.Stop = StartPanel.Stop;
            Panels = new HeadsetPanels(Input, port, bodies, RobotPanels);
            views = new PanelViews(Panels, transform, rayMaterial);
        }

        /// <summary>The wearer has answered a question of the system, or changed the settings. It is reported to every session.</summary>
        public void SetPermission(HeadsetPermission permission, bool isGranted)
        {
            permissions[(int)permission] = isGranted ? PermissionState.Granted : PermissionState.Denied;
            if (client != null) ReportPermission(permission, isGranted);
        }

        private void Update()
        {
            try
            {
                if (reader == null) reader = new ControlReader(Controls, ControlsKind);
                if (Input == null && (client != null || Problem.Length > 0)) StepStops(); // needs the reader alone of all that may be in the way
                else StepDevices();
            }
            catch (Exception error)
            {
                EndInput(error);
            }
        }

        private void StepDevices()
        {
            reader.BareHands = BareHands;
            condition.Refresh();
            if (Input != null) Step();
            else StepStart();
        }

        private void Step()
        {
            HeadsetReading reading = Input.Reading;
            reader.Read(reading);
            Taps?.Apply(Input);
            ReportCondition(reading);
            while (client.TryTakeNews(out SessionNews news))
            {
                Input.Take(news, reading.CaptureNs);
                Pass(news);
                if (client == null) return; // it has left the session
            }
            HeadsetInput input = Input;
            input.Update(IsLive, client.Suspensions);
            if (Input != input) return; // a command has left the session
            if (Input.CommandError != null) Debug.LogException(Input.CommandError);
            Input.CommandError = null;
            ShowPanels(reading);
        }

        private bool IsLive { get { return client.IsLive && focus == AppFocus.Focused; } }

        private void StepStart()
        {
            condition.HasMoved = false; // a session that is joined later is aligned in the frame of then
            reader.Read(ownReading);
            ShowStart();
        }

        /// <summary>After a defect: no samples, so that robots hold; the e-stop goes on, and the panel that says so.</summary>
        private void StepStops()
        {
            try
            {
                reader.Read(ownReading);
            }
            catch (Exception)
            {
                reader.ReadStops(ownReading); // the defect may be in what is read
            }
            string reason = client == null ? null : stops.Update(ownReading, IsLive);
            if (reason != null) StopAll(reason);
            while (client != null && client.TryTakeNews(out SessionNews news)) Pass(news);
            if (Input == null) ShowStart(); // no session was joined by news
        }

        private void StopAll(string reason)
        {
            port.EStop(reason);
            StartPanel?.Stop.Press(ownReading.CaptureNs);
        }

        private void ShowStart()
        {
            if (StartPanel == null) return;
            StartPanel.Update(ownReading);
            if (startViews == null) startViews = new PanelViews(StartPanel, transform, rayMaterial);
            startViews.Update(ownReading.Head.Position);
        }

        /// <summary>A defect: it is said once, robots hold as no samples come any more, and the e-stop goes on.</summary>
        private void EndInput(Exception error)
        {
            if (Input == null && Problem.Length > 0) return; // also after a defect of panels alone, the e-stop goes on
            Debug.LogException(error);
            Problem = "the headset cannot be read: " + error.Message + (client == null ? "" : AfterDefect);
            if (client == null) return;
            Input = null;
            stops = new StopInput();
            if (StartPanel != null) StartPanel.Session = port;
            RemovePanels();
        }

        /// <summary>Hand news to the application. What it throws is its own: samples and the e-stop go on.</summary>
        private void Pass(SessionNews news)
        {
            try
            {
                News?.Invoke(news);
            }
            catch (Exception error)
            {
                Debug.LogException(error);
            }
        }

        private void ShowPanels(HeadsetReading reading)
        {
            if (views == null) return;
            try
            {
                Panels.Update(client.Advice, Notice);
                views.Update(reading.Head.Position);
            }
            catch (Exception error)
            {
                // A defect: it is said once, and without panels samples and the e-stop go on.
                Debug.LogException(error);
                RemovePanels();
                Problem = "panels cannot be drawn: " + error.Message;
            }
        }

        private void RemovePanels()
        {
            views?.Destroy();
            startViews?.Destroy();
            views = startViews = null;
        }

        private void ReportCondition(HeadsetReading reading)
        {
            if (condition.HasMoved)
            {
                condition.HasMoved = false;
                Input.OnRecentred();
            }
            bool isOnHead = reader.IsOnHead;
            if (isOnHead != wasOnHead) ReportOnHead(isOnHead);
            bool isTracking = reading.HeadValidity != PoseValidity.NotSeen || !reading.HasHead;
            if (isTracking != wasTracking) ReportTracking(isTracking);
            if (Time.realtimeSinceStartupAsDouble < conditionAt) return;
            conditionAt = Time.realtimeSinceStartupAsDouble + ConditionS;
            ReportHealth(condition.Read());
            string losses = client.DescribeLosses();
            if (losses != null) Debug.LogWarning("iris-session: " + losses);
            bool hasMarkers = MarkerSource != null && MarkerSource.Support != MarkerSupport.Missing;
            if (hasMarkers != hadMarkers) ReportMarkers(hasMarkers);
        }

        // Each in a method of its own: what a lambda captures is allocated where it is declared, and other frames allocate nothing.

        private void ReportOnHead(bool isOnHead)
        {
            wasOnHead = isOnHead;
            client.Post(loop => loop.Headset.SetOnHead(isOnHead));
        }

        private void ReportTracking(bool isTracking)
        {
            wasTracking = isTracking;
            client.Post(loop => loop.Headset.SetTracking(isTracking));
        }

        private void ReportFocus(AppFocus now)
        {
            client.Post(loop => loop.Headset.SetFocus(now));
        }

        private void ReportMarkers(bool hasMarkers)
        {
            hadMarkers = hasMarkers;
            client.Post(loop => loop.Headset.HasMarkerSupport = hasMarkers);
        }

        private void ReportPermission(HeadsetPermission permission, bool isGranted)
        {
            client.Post(loop => loop.Headset.SetPermission(permission, isGranted));
        }

        private void ReportHealth(DeviceHealth health)
        {
            client.TryPost(loop => loop.Health.Newest = health);
        }

        private void OnApplicationPause(bool pauseStatus)
        {
            isPaused = pauseStatus;
            ReportFocus();
        }

        private void OnApplicationFocus(bool hasFocus)
        {
            this.hasFocus = hasFocus;
            ReportFocus();
        }

        private void ReportFocus()
        {
            AppFocus now = isPaused ? AppFocus.Background : hasFocus ? AppFocus.Focused : AppFocus.Covered;
            if (now == focus) return;
            focus = now;
            if (client != null) ReportFocus(now);
        }

        private void OnDestroy()
        {
            try
            {
                Connect(null, null);
            }
            catch (Exception error)
            {
                Debug.LogException(error);
            }
            reader?.Dispose();
            (BareHands as IDisposable)?.Dispose();
            haptics?.Dispose();
            condition.Dispose();
        }
    }
}
