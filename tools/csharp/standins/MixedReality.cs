// Markers of Microsoft's Mixed Reality OpenXR plug-in, as objects below the origin's parent of trackables.
using UnityEngine;
using UnityEngine.XR.ARFoundation;
using UnityEngine.XR.ARSubsystems;

namespace Microsoft.MixedReality.OpenXR
{
    public enum TransformMode
    {
        MostStable = 0,
        Center = 1,
    }

    public enum ARMarkerType
    {
        QRCode = 1,
    }

    /// <summary>The subsystem is one of this plug-in, with these names.</summary>
    public sealed class ARMarkerManager : ARTrackableManager<XRMarkerSubsystem, XRMarkerSubsystemDescriptor, XRMarkerSubsystem.Provider, ARSubsystems.XRMarker, ARMarker>
    {
        public ARMarkerType[] enabledMarkerTypes;
        public TransformMode defaultTransformMode;
    }

    public sealed class ARMarker : ARTrackable<ARSubsystems.XRMarker, ARMarker>
    {
        internal string Data = "";

        public float lastSeenTime { get; internal set; }

        public Vector2 size { get; internal set; }

        public TransformMode transformMode { get; set; }

        public string GetDecodedString() { return Data; }
    }
}

namespace Microsoft.MixedReality.OpenXR.ARSubsystems
{
    public struct XRMarker
    {
    }
}
