// Hands of the package XR Hands.
using System.Collections.Generic;
using UnityEngine.SubsystemsImplementation;
using UnityEngine.XR.Hands.ProviderImplementation;

namespace UnityEngine.XR.Hands
{
    public enum Handedness
    {
        Invalid = 0,
        Left = 1,
        Right = 2,
    }

    public enum XRHandJointID
    {
        Wrist = 1,
        Palm = 2,
        ThumbTip = 6,
        IndexTip = 11,
        MiddleProximal = 13,
        MiddleTip = 16,
        EndMarker = 27,
    }

    public struct XRHandJoint
    {
        internal Pose? At;

        public XRHandJointID id { get; internal set; }

        public bool TryGetPose(out Pose pose)
        {
            pose = At ?? default;
            return At.HasValue;
        }
    }

    public struct XRHand
    {
        internal Dictionary<XRHandJointID, Pose> Joints;

        public Handedness handedness { get; internal set; }

        public bool isTracked { get; internal set; }

        public XRHandJoint GetJoint(XRHandJointID id)
        {
            bool isThere = Joints != null && Joints.TryGetValue(id, out _);
            return new XRHandJoint { id = id, At = isThere ? Joints[id] : (Pose?)null };
        }
    }

    public class XRCommonHandGestures
    {
        /// <summary>Whether the runtime has enabled the hand interaction profile: without it there are no poses.</summary>
        internal static bool HasProfile;
        internal Pose? Aim;

        public bool TryGetAimPose(out Pose aimPose)
        {
            aimPose = Aim ?? default;
            return HasProfile && Aim.HasValue;
        }
    }

    public class XRHandSubsystemDescriptor
    {
    }

    public class XRHandSubsystem : SubsystemWithProvider<XRHandSubsystem, XRHandSubsystemDescriptor, XRHandSubsystemProvider>
    {
        public XRHandSubsystem()
        {
            leftHandCommonGestures = new XRCommonHandGestures();
            rightHandCommonGestures = new XRCommonHandGestures();
        }

        public XRHand leftHand { get; internal set; }

        public XRHand rightHand { get; internal set; }

        public XRCommonHandGestures leftHandCommonGestures { get; }

        public XRCommonHandGestures rightHandCommonGestures { get; }
    }
}

namespace UnityEngine.XR.Hands.ProviderImplementation
{
    public abstract class XRHandSubsystemProvider
    {
    }
}
