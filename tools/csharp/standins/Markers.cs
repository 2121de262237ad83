// Markers of AR Foundation, as objects below the origin's parent of trackables; and the poses of both.
using UnityEngine.XR.ARSubsystems;

namespace UnityEngine
{
    public struct Pose
    {
        public Vector3 position;
        public Quaternion rotation;

        public Pose(Vector3 position, Quaternion rotation)
        {
            this.position = position;
            this.rotation = rotation;
        }
    }
}

namespace UnityEngine.XR.ARSubsystems
{
    public enum TrackingState
    {
        None = 0,
        Limited = 1,
        Tracking = 2,
    }

    public struct TrackableId
    {
        public TrackableId(ulong subId1, ulong subId2)
        {
            this.subId1 = subId1;
            this.subId2 = subId2;
        }

        public ulong subId1 { get; set; }

        public ulong subId2 { get; set; }

        public override string ToString() { return subId1.ToString("X16") + "-" + subId2.ToString("X16"); }
    }

    public readonly struct XRResultStatus
    {
        private readonly bool isGood;

        public XRResultStatus(bool wasSuccessful)
        {
            isGood = wasSuccessful;
        }

        public bool IsSuccess() { return isGood; }
    }

    public struct Result<T>
    {
        public Result(XRResultStatus status, T value)
        {
            this.status = status;
            this.value = value;
        }

        public XRResultStatus status { get; }

        public T value { get; }
    }

    public struct XRMarker
    {
    }
}

namespace UnityEngine.XR.ARFoundation
{
    public abstract class ARTrackable : MonoBehaviour
    {
    }

    public class ARTrackable<TSessionRelativeData, TTrackable> : ARTrackable
    {
        public TrackableId trackableId { get; internal set; }

        public TrackingState trackingState { get; internal set; } = TrackingState.Tracking;
    }

    public class ARMarker : ARTrackable<XRMarker, ARMarker>
    {
        internal string Data;
        internal int Reads;

        public Vector2 size { get; internal set; }

        public Result<string> TryGetStringData()
        {
            Reads++;
            return new Result<string>(new XRResultStatus(Data != null), Data);
        }
    }
}

namespace UnityEngine.XR.ARSubsystems
{
    public class XRSessionSubsystem
    {
        public class Provider
        {
        }
    }

    public class XRSessionSubsystemDescriptor
    {
    }

    public class XRCameraSubsystem
    {
        public class Provider
        {
        }
    }

    public class XRCameraSubsystemDescriptor
    {
    }

    public class XRMarkerSubsystem
    {
        public abstract class Provider
        {
        }
    }

    public class XRMarkerSubsystemDescriptor
    {
    }
}

namespace UnityEngine.XR.ARFoundation
{
    public class SubsystemLifecycleManager<TSubsystem, TSubsystemDescriptor, TProvider> : MonoBehaviour
    {
    }

    public abstract class ARTrackableManager<TSubsystem, TSubsystemDescriptor, TProvider, TSessionRelativeData, TTrackable> : SubsystemLifecycleManager<TSubsystem, TSubsystemDescriptor, TProvider>
    {
    }

    public sealed class ARSession : SubsystemLifecycleManager<XRSessionSubsystem, XRSessionSubsystemDescriptor, XRSessionSubsystem.Provider>
    {
    }

    public sealed class ARCameraManager : SubsystemLifecycleManager<XRCameraSubsystem, XRCameraSubsystemDescriptor, XRCameraSubsystem.Provider>
    {
    }

    public class ARMarkerManager : ARTrackableManager<XRMarkerSubsystem, XRMarkerSubsystemDescriptor, XRMarkerSubsystem.Provider, XRMarker, ARMarker>
    {
    }
}

namespace Unity.XR.CoreUtils
{
    public class XROrigin : UnityEngine.MonoBehaviour
    {
        public enum TrackingOriginMode
        {
            NotSpecified = 0,
            Device = 1,
            Floor = 2,
        }

        internal UnityEngine.Transform Trackables;

        public UnityEngine.Transform TrackablesParent { get { return Trackables; } }

        public UnityEngine.GameObject Origin { get; set; }

        public UnityEngine.GameObject CameraFloorOffsetObject { get; set; }

        public UnityEngine.Camera Camera { get; set; }

        public TrackingOriginMode RequestedTrackingOriginMode { get; set; }
    }
}
