// QR codes by Microsoft's ARMarkerManager. The driver remembers codes for as long as the device runs, those of other apps too: only the
// time of the last sight tells what is seen.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Protocol;
using IrisSession.Transport;
using IrisSession.Unity.Input;
using Microsoft.MixedReality.OpenXR;
using Unity.XR.CoreUtils;
using UnityEngine;
using UnityEngine.XR.ARSubsystems;

namespace IrisSession.HoloLens
{
    /// <summary>Codes that HoloLens tracks: objects below the origin's parent of trackables.</summary>
    public sealed class HoloLensMarkers : IMarkerSource
    {
        private sealed class Known
        {
            public readonly MarkerReport Report = new MarkerReport();
            public ARMarker Marker;
        }

        private readonly XROrigin origin;
        private readonly ARMarkerManager manager;
        private readonly MarkerSwitch search;
        private readonly Transform trackingFrame;
        private readonly List<Known> markers = new List<Known>();

        /// <param name="manager">With QR codes enabled; null: there is none.</param>
        /// <param name="trackingFrame">The frame of the headset's poses: the origin's camera offset.</param>
        public HoloLensMarkers(XROrigin origin, ARMarkerManager manager, Transform trackingFrame)
        {
            this.origin = origin;
            this.manager = manager;
            search = new MarkerSwitch(manager, Judge);
            this.trackingFrame = trackingFrame;
        }

        public MarkerSupport Support { get { return search.Support; } }

        public string Source { get { return ObservationSource.QrSystem; } }

        public void SetActive(bool isActive) { search.Set(isActive); }

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
            if (manager.subsystem == null) return MarkerSupport.Missing;
            return manager.subsystem.running ? MarkerSupport.Ready : MarkerSupport.Starting;
        }

        private MarkerReport Fill(Known known)
        {
            ARMarker marker = known.Marker;
            MarkerReport report = known.Report;
            if (report.Text.Length == 0) report.Text = marker.GetDecodedString() ?? "";
            report.IsTracked = marker.trackingState == TrackingState.Tracking;
            double ageS = Time.realtimeSinceStartupAsDouble - marker.lastSeenTime;
            report.SeenNs = System.Math.Max(0, MonotonicClock.NowNs - (long)(1e9 * ageS));
            Vector3 position = trackingFrame.InverseTransformPoint(marker.transform.position);
            Quaternion rotation = Quaternion.Inverse(trackingFrame.rotation) * marker.transform.rotation;
            report.Pose = MarkerAxes.FromMicrosoftCenter(EnginePoses.ToUnityPose(position, rotation), marker.size.x, marker.size.y);
            return report;
        }

        private Known Find(ARMarker marker)
        {
            foreach (Known one in markers) if (ReferenceEquals(one.Marker, marker)) return one;
            Known added = new Known { Marker = marker };
            added.Report.Id = marker.trackableId.ToString();
            marker.transformMode = TransformMode.Center; // the default has its origin in a corner
            markers.Add(added);
            return added;
        }
    }
}
