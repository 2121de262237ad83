// QR codes by AR Foundation's ARMarkerManager (Spatial Entities), and the view of the room by its ARCameraManager.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Protocol;
using IrisSession.Unity.Input;
using Unity.XR.CoreUtils;
using Unity.XR.CoreUtils.Collections;
using UnityEngine;
using UnityEngine.XR.ARFoundation;
using UnityEngine.XR.ARSubsystems;

namespace IrisSession.Unity.ArFoundation
{
    /// <summary>Codes that AR Foundation tracks: objects below the origin's parent of trackables.</summary>
    public sealed class ArMarkers : IMarkerSource
    {
        /// <summary>A code whose text is not there yet is asked for it so often [frames]: the call makes a string.</summary>
        private const int AskEvery = 30;

        private sealed class Known
        {
            public readonly MarkerReport Report = new MarkerReport();
            public ARMarker Marker;
            public int Age;
        }

        private readonly XROrigin origin;
        private readonly ARMarkerManager manager;
        private readonly MarkerSwitch search;
        private readonly Transform trackingFrame;
        private readonly List<Known> markers = new List<Known>();

        /// <param name="manager">Null: this device has none. It stays off until the permission is there.</param>
        /// <param name="trackingFrame">The frame of the headset's poses: the origin's camera offset.</param>
        public ArMarkers(XROrigin origin, ARMarkerManager manager, Transform trackingFrame)
        {
            this.origin = origin;
            this.manager = manager;
            search = new MarkerSwitch(manager, Judge);
            this.trackingFrame = trackingFrame;
        }

        /// <summary>Set by what asks for the permission: `com.oculus.permission.USE_SCENE` on Quest.</summary>
        public bool IsAllowed { get; set; } = true;

        public MarkerSupport Support { get { return manager == null || IsAllowed ? search.Support : MarkerSupport.NotAllowed; } }

        public string Source { get { return ObservationSource.QrSystem; } }

        public void SetActive(bool isActive) { search.Set(isActive && IsAllowed); }

        public int Read(List<MarkerReport> reports)
        {
            reports.Clear();
            Transform parent = origin.TrackablesParent;
            for (int i = 0; i < parent.childCount; i++)
            {
                ARMarker marker = parent.GetChild(i).GetComponent<ARMarker>();
                if (marker != null) reports.Add(Fill(Find(marker)));
            }
            markers.RemoveAll(one => one.Marker == null); // destroyed
            return reports.Count;
        }

        private MarkerSupport Judge()
        {
            XRMarkerSubsystem subsystem = manager.subsystem;
            if (subsystem == null) return MarkerSupport.Missing; // no provider, or its feature is not in the build
            if (!subsystem.running) return MarkerSupport.Starting;
            Result<ReadOnlyListSpan<XRMarkerType>> types = subsystem.subsystemDescriptor.supportedMarkerTypes;
            if (types.status.IsError()) return MarkerSupport.Missing;
            for (int i = 0; i < types.value.Count; i++) if (types.value[i] == XRMarkerType.QRCode) return MarkerSupport.Ready;
            return MarkerSupport.Missing;
        }

        private MarkerReport Fill(Known known)
        {
            ARMarker marker = known.Marker;
            MarkerReport report = known.Report;
            if (report.Text.Length == 0 && known.Age++ % AskEvery == 0)
            {
                Result<string> data = marker.TryGetStringData();
                if (data.status.IsSuccess() && data.value != null) report.Text = data.value;
            }
            report.IsTracked = marker.trackingState == TrackingState.Tracking;
            Vector3 position = trackingFrame.InverseTransformPoint(marker.transform.position);
            Quaternion rotation = Quaternion.Inverse(trackingFrame.rotation) * marker.transform.rotation;
            report.Pose = MarkerAxes.FromArFoundation(EnginePoses.ToUnityPose(position, rotation), marker.size.x, marker.size.y);
            return report;
        }

        private Known Find(ARMarker marker)
        {
            foreach (Known one in markers) if (ReferenceEquals(one.Marker, marker)) return one;
            Known added = new Known { Marker = marker };
            added.Report.Id = marker.trackableId.ToString();
            markers.Add(added);
            return added;
        }
    }

    /// <summary>Passthrough: on while the component that asks for it is.</summary>
    public sealed class ArPassthrough : IPassthrough
    {
        private readonly Behaviour cameraManager;

        /// <param name="cameraManager">The ARCameraManager, null: there is none.</param>
        public ArPassthrough(Behaviour cameraManager)
        {
            this.cameraManager = cameraManager;
        }

        public bool IsSupported { get { return cameraManager != null; } }

        public bool IsOn
        {
            get { return cameraManager != null && cameraManager.enabled; }
            set { if (cameraManager != null) cameraManager.enabled = value; }
        }
    }
}
