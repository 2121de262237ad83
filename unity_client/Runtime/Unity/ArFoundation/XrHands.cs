// Bare hands by the package XR Hands.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Unity.Input;
using UnityEngine;
using UnityEngine.InputSystem;
using UnityEngine.XR.Hands;

namespace IrisSession.Unity.ArFoundation
{
    /// <summary>Hands that the runtime tracks: pinch is the trigger, a fist the squeeze. Dispose of it to give the actions back.</summary>
    public sealed class XrHands : IHands, IDisposable
    {
        private const int JointCount = 26;
        private const int RowLength = 7;

        private readonly List<XRHandSubsystem> subsystems = new List<XRHandSubsystem>();
        private readonly double[][] joints = { new double[JointCount * RowLength], new double[JointCount * RowLength] };
        private readonly Aim[] aims = { new Aim("<MetaAimHand>{LeftHand}/"), new Aim("<MetaAimHand>{RightHand}/") };
        private XRHandSubsystem subsystem;

        public bool IsSupported
        {
            get
            {
                if (subsystem != null && subsystem.running) return true;
                SubsystemManager.GetSubsystems(subsystems);
                subsystem = null;
                foreach (XRHandSubsystem one in subsystems) if (one.running) subsystem = one;
                return subsystem != null;
            }
        }

        public bool TryRead(Side side, bool wantsJoints, InputReading reading)
        {
            XRHand hand = side == Side.Left ? subsystem.leftHand : subsystem.rightHand;
            if (!hand.isTracked) return false;
            if (reading.Kind != InputKind.Hand) reading.HasPose = false; // that of another device
            reading.Clear();
            reading.Kind = InputKind.Hand;
            reading.IsPresent = true;
            bool isWhole = TryFind(hand, XRHandJointID.Wrist, out RigidTransform wrist) & TryFind(hand, XRHandJointID.ThumbTip, out RigidTransform thumb)
                & TryFind(hand, XRHandJointID.IndexTip, out RigidTransform index) & TryFind(hand, XRHandJointID.MiddleTip, out RigidTransform middle)
                & TryFind(hand, XRHandJointID.MiddleProximal, out RigidTransform knuckle);
            if (!isWhole) return true;
            reading.Pose = wrist;
            reading.HasPose = reading.HasTip = true;
            reading.Validity = PoseValidity.Measured;
            reading.Tip = index.Position;
            reading.Trigger = Gestures.Pinch(thumb.Position, index.Position);
            reading.Squeeze = Gestures.Fist(wrist.Position, knuckle.Position, middle.Position);
            XRCommonHandGestures gestures = side == Side.Left ? subsystem.leftHandCommonGestures : subsystem.rightHandCommonGestures;
            reading.HasRay = aims[(int)side].TryRead(out Pose aim) || gestures.TryGetAimPose(out aim);
            if (reading.HasRay) reading.Ray = AimRay.Along(EnginePoses.ToWire(aim.position, aim.rotation));
            if (wantsJoints) reading.Joints = ReadJoints(hand, joints[(int)side]);
            return true;
        }

        public void Dispose()
        {
            foreach (Aim one in aims) one.Dispose();
        }

        /// <summary>Return the rows of all joints in the order of OpenXR (the palm first); none unless all are known.</summary>
        private static double[] ReadJoints(XRHand hand, double[] rows)
        {
            for (XRHandJointID id = XRHandJointID.Wrist; id < XRHandJointID.EndMarker; id++)
            {
                if (!TryFind(hand, id, out RigidTransform pose)) return InputReading.NoJoints;
                // XR Hands has the wrist before the palm, and counts from 1.
                pose.WriteRow(rows, id == XRHandJointID.Palm ? 0 : id == XRHandJointID.Wrist ? 1 : (int)id - 1);
            }
            return rows;
        }

        private static bool TryFind(XRHand hand, XRHandJointID id, out RigidTransform pose)
        {
            bool isThere = hand.GetJoint(id).TryGetPose(out Pose found);
            pose = isThere ? EnginePoses.ToWire(found.position, found.rotation) : RigidTransform.Identity;
            return isThere;
        }

        /// <summary>
        /// Where a hand points, by the feature "Meta Hand Tracking Aim": it is a device of the Input System. The gestures of XR Hands have
        /// a ray only where the runtime has enabled the hand interaction profile, whose devices would be taken for controllers.
        /// </summary>
        private sealed class Aim : IDisposable
        {
            /// <summary>`MetaAimFlags.Valid`: the hand points away from the face.</summary>
            private const int Valid = 2;

            private readonly InputAction position;
            private readonly InputAction rotation;
            private readonly InputAction flags;

            public Aim(string device)
            {
                position = Bind(device + "devicePosition");
                rotation = Bind(device + "deviceRotation");
                flags = Bind(device + "aimFlags");
            }

            public bool TryRead(out Pose pose)
            {
                pose = new Pose(position.ReadValue<Vector3>(), rotation.ReadValue<Quaternion>());
                return (flags.ReadValue<int>() & Valid) != 0;
            }

            public void Dispose()
            {
                position.Dispose();
                rotation.Dispose();
                flags.Dispose();
            }

            private static InputAction Bind(string path)
            {
                InputAction action = new InputAction(binding: path);
                action.Enable();
                return action;
            }
        }
    }
}
