// Trackables of Meta's MR Utility Kit: objects that tests make, place and destroy.
using System.Collections.Generic;
using UnityEngine;

public readonly struct OVRAnchor
{
    public enum TrackableType
    {
        None = 0,
        Keyboard = 1,
        QRCode = 2,
    }

    public struct TrackerConfiguration
    {
        public bool KeyboardTrackingEnabled { get; set; }

        public bool QRCodeTrackingEnabled { get; set; }
    }
}

namespace Meta.XR.MRUtilityKit
{
    public class MRUKAnchor : MonoBehaviour
    {
        public Rect? PlaneRect { get; internal set; }
    }

    public sealed class MRUKTrackable : MRUKAnchor
    {
        internal int Reads;
        internal string Payload;

        public OVRAnchor.TrackableType TrackableType { get; internal set; } = OVRAnchor.TrackableType.QRCode;

        public bool IsTracked { get; internal set; } = true;

        public string MarkerPayloadString
        {
            get
            {
                Reads++;
                return Payload;
            }
        }
    }

    public class MRUK : MonoBehaviour
    {
        internal readonly List<MRUKTrackable> All = new List<MRUKTrackable>();

        /// <summary>As the kit has it by default: it moves the tracking space.</summary>
        public bool EnableWorldLock = true;
        public MRUKSettings SceneSettings = new MRUKSettings();

        public bool QRCodeTrackingSupported { get; internal set; } = true;

        public void GetTrackables(List<MRUKTrackable> trackables)
        {
            trackables.Clear();
            foreach (MRUKTrackable one in All) if (one != null) trackables.Add(one);
        }

        public class MRUKSettings
        {
            public OVRAnchor.TrackerConfiguration TrackerConfiguration { get; set; }
        }
    }
}

namespace UnityEngine
{
    public struct Rect
    {
        private readonly Vector2 corner;
        private readonly Vector2 extent;

        public Rect(float x, float y, float width, float height)
        {
            corner = new Vector2(x, y);
            extent = new Vector2(width, height);
        }

        public float width { get { return extent.x; } }

        public float height { get { return extent.y; } }

        public Vector2 center { get { return new Vector2(corner.x + 0.5f * extent.x, corner.y + 0.5f * extent.y); } }
    }
}
