// QR codes by Meta's MR Utility Kit (MRUK), for projects that have it instead of AR Foundation's markers.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Protocol;
using IrisSession.Unity.Input;
using Meta.XR.MRUtilityKit;
using UnityEngine;

namespace IrisSession.Unity.Mruk
{
    /// <summary>Codes that MRUK tracks. It updates them about once a second, and does not say when it saw them.</summary>
    public sealed class MrukMarkers : IMarkerSource
    {
        private sealed class Known
        {
            public readonly MarkerReport Report = new MarkerReport();
            public MRUKTrackable Trackable;
            public bool IsThere;
        }

        private readonly MRUK mruk;
        private readonly Transform rigSpace;
        private readonly List<MRUKTrackable> trackables = new List<MRUKTrackable>();
        private readonly List<Known> markers = new List<Known>();
        private readonly Predicate<Known> isGone = one => !one.IsThere;
        private int made;

        /// <param name="mruk">`MRUK.Instance`, null: there is none. Its world lock is switched off: the alignment owns the origin.</param>
        /// <param name="rigSpace">Tracking space of the OVRCameraRig. Null: there is no such rig (but an XROrigin), so MRUK's poses are in the tracking frame.</param>
        public MrukMarkers(MRUK mruk, Transform rigSpace)
        {
            this.mruk = mruk;
            this.rigSpace = rigSpace;
            if (mruk != null) mruk.EnableWorldLock = false;
        }

        /// <summary>Set by what asks for the permission: see <see cref="ScenePermission"/>. MRUK does not search before.</summary>
        public bool IsAllowed { get; set; } = true;

        public MarkerSupport Support
        {
            get { return mruk == null || !mruk.QRCodeTrackingSupported ? MarkerSupport.Missing : IsAllowed ? MarkerSupport.Ready : MarkerSupport.NotAllowed; }
        }

        public string Source { get { return ObservationSource.QrSystem; } }

        public void SetActive(bool isActive)
        {
            if (mruk == null) return;
            bool isOn = isActive && Support == MarkerSupport.Ready;
            OVRAnchor.TrackerConfiguration wanted = mruk.SceneSettings.TrackerConfiguration;
            if (wanted.QRCodeTrackingEnabled == isOn) return;
            wanted.QRCodeTrackingEnabled = isOn;
            mruk.SceneSettings.TrackerConfiguration = wanted;
        }

        public int Read(List<MarkerReport> reports)
        {
            reports.Clear();
            if (mruk == null) return 0;
            foreach (Known one in markers) one.IsThere = false;
            mruk.GetTrackables(trackables);
            foreach (MRUKTrackable trackable in trackables)
                if (trackable.TrackableType == OVRAnchor.TrackableType.QRCode) reports.Add(Fill(Find(trackable)));
            markers.RemoveAll(isGone);
            return reports.Count;
        }

        private MarkerReport Fill(Known known)
        {
            MRUKTrackable trackable = known.Trackable;
            MarkerReport report = known.Report;
            known.IsThere = true;
            if (report.Text.Length == 0) report.Text = trackable.MarkerPayloadString ?? "";
            report.IsTracked = trackable.IsTracked;
            Vector3 position = trackable.transform.position;
            Quaternion rotation = trackable.transform.rotation;
            if (rigSpace != null)
            {
                position = rigSpace.InverseTransformPoint(position);
                rotation = Quaternion.Inverse(rigSpace.rotation) * rotation;
            }
            Rect plane = trackable.PlaneRect ?? default; // none: a code without size, which is no look
            report.Pose = MarkerAxes.FromMruk(EnginePoses.ToUnityPose(position, rotation), plane.center.x, plane.center.y, plane.width, plane.height);
            return report;
        }

        private Known Find(MRUKTrackable trackable)
        {
            foreach (Known one in markers) if (ReferenceEquals(one.Trackable, trackable)) return one;
            Known added = new Known { Trackable = trackable };
            added.Report.Id = (++made).ToString();
            markers.Add(added);
            return added;
        }
    }
}
