// Markers of AR Foundation, as objects below the origin's parent of trackables; and the poses of both.
using System.Collections.Generic;
using Standins;
using Unity.XR.CoreUtils.Collections;
using UnityEngine.SubsystemsImplementation;
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

        public bool IsError() { return !isGood; }
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

    public enum XRMarkerType
    {
        QRCode = 1000743000,
        ArUco = 1000743002,
    }

    public class XRSubsystem<TSubsystem, TSubsystemDescriptor, TProvider> : SubsystemWithProvider<TSubsystem, TSubsystemDescriptor, TProvider>
    {
        /// <summary>Starts that were asked for.</summary>
        internal int Starts;

        /// <summary>Why it cannot start, null: it can.</summary>
        internal string Failure;

        /// <summary>Whether it runs only when a test says so.</summary>
        internal bool IsSlow;
    }

    public abstract class TrackingSubsystem<TTrackable, TSubsystem, TSubsystemDescriptor, TProvider> : XRSubsystem<TSubsystem, TSubsystemDescriptor, TProvider>
    {
    }

    public class XRMarkerSubsystem : TrackingSubsystem<XRMarker, XRMarkerSubsystem, XRMarkerSubsystemDescriptor, XRMarkerSubsystem.Provider>
    {
        /// <summary>Make one that reads codes of these types.</summary>
        internal static XRMarkerSubsystem Make(params XRMarkerType[] types)
        {
            ReadOnlyListSpan<XRMarkerType> list = new ReadOnlyListSpan<XRMarkerType>(types);
            return new XRMarkerSubsystem { subsystemDescriptor = new XRMarkerSubsystemDescriptor { supportedMarkerTypes = new Result<ReadOnlyListSpan<XRMarkerType>>(new XRResultStatus(true), list) } };
        }

        public abstract class Provider
        {
        }
    }

    public class XRMarkerSubsystemDescriptor
    {
        public Result<ReadOnlyListSpan<XRMarkerType>> supportedMarkerTypes { get; internal set; }
    }
}

namespace UnityEngine.XR.ARFoundation
{
    public class SubsystemLifecycleManager<TSubsystem, TSubsystemDescriptor, TProvider> : MonoBehaviour where TSubsystem : class
    {
        public TSubsystem subsystem { get; private set; }

        private void OnEnable()
        {
            subsystem = Subsystems.Loaded.Find(one => one is TSubsystem) as TSubsystem;
            if (!(subsystem is XRSubsystem<TSubsystem, TSubsystemDescriptor, TProvider> found)) return;
            found.Starts++;
            if (found.Failure != null)
            {
                Debug.LogError(found.Failure);
                enabled = false;
            }
            else if (!found.IsSlow) found.Start();
        }

        private void OnDisable() { (subsystem as SubsystemWithProvider)?.Stop(); }
    }

    public abstract class ARTrackableManager<TSubsystem, TSubsystemDescriptor, TProvider, TSessionRelativeData, TTrackable> : SubsystemLifecycleManager<TSubsystem, TSubsystemDescriptor, TProvider>
        where TSubsystem : class
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

namespace Unity.XR.CoreUtils.Collections
{
    public struct ReadOnlyListSpan<T>
    {
        private readonly IReadOnlyList<T> list;

        public ReadOnlyListSpan(IReadOnlyList<T> list)
        {
            this.list = list;
        }

        public int Count { get { return list == null ? 0 : list.Count; } }

        public T this[int index] { get { return list[index]; } }
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
