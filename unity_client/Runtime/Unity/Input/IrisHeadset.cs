// The component that reads a headset: put it on the object in whose frame the headset tracks, beside IrisWorld.
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

        [SerializeField] private Material rayMaterial = null;
        private readonly DeviceCondition condition = new DeviceCondition();
        private ControlReader reader;
        private ControllerHaptics haptics;
        private SessionClient client;
        private SessionClientPort port;
        private PanelViews views;
        private double conditionAt;
        private bool isPaused;
        private bool hasFocus = true;
        private bool wasOnHead = true;
        private bool wasTracking = true;
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
            if (client == null) return;
            if (reader == null) reader = new ControlReader(Controls, ControlsKind);
            if (haptics == null) haptics = new ControllerHaptics();
            reader.BareHands = BareHands;
            port = new SessionClientPort(client);
            Input = new HeadsetInput(port, bodies, haptics) { Markers = MarkerSource == null ? null : new MarkerLooks(MarkerSource) };
            Panels = new HeadsetPanels(Input, port, bodies);
            views = new PanelViews(Panels, transform, rayMaterial);
        }

        private void Update()
        {
            if (Input == null) return;
            try
            {
                Step();
            }
            catch (Exception error)
            {
                // A defect: it is said once, and robots hold, as no samples come any more.
                Debug.LogException(error);
                Connect(null, null);
                Problem = "the headset cannot be read: " + error.Message;
            }
        }

        private void Step()
        {
            HeadsetReading reading = Input.Reading;
            reader.Read(reading);
            ReportCondition(reading);
            while (client.TryTakeNews(out SessionNews news))
            {
                Input.Take(news, reading.CaptureNs);
                News?.Invoke(news);
            }
            Input.Update(client.IsLive && focus == AppFocus.Focused, client.Suspensions, client.View.BodiesVersion);
            Panels.Update(client.Advice, Notice);
            views.Update(reading.Head.Position);
        }

        private void ReportCondition(HeadsetReading reading)
        {
            if (condition.HasMoved)
            {
                condition.HasMoved = false;
                Input.OnRecentred();
            }
            bool isOnHead = reader.IsOnHead;
            if (isOnHead != wasOnHead) client.TryPost(loop => loop.Headset.SetOnHead(isOnHead));
            wasOnHead = isOnHead;
            bool isTracking = reading.HeadValidity != PoseValidity.NotSeen || !reading.HasHead;
            if (isTracking != wasTracking) client.TryPost(loop => loop.Headset.SetTracking(isTracking));
            wasTracking = isTracking;
            if (Time.realtimeSinceStartupAsDouble < conditionAt) return;
            conditionAt = Time.realtimeSinceStartupAsDouble + ConditionS;
            condition.Refresh();
            DeviceHealth health = condition.Read();
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
            client?.TryPost(loop => loop.Headset.SetFocus(now));
        }

        private void OnDestroy()
        {
            Connect(null, null);
            reader?.Dispose();
            haptics?.Dispose();
            condition.Dispose();
        }
    }
}
