// Head, controllers and gaze by the Input System, with the OpenXR plug-in's layouts. Poses are those of the tracking frame: of an XR
// origin, its camera offset.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Transport;
using UnityEngine;
using UnityEngine.InputSystem;

namespace IrisSession.Unity.Input
{
    /// <summary>Names of controls that differ between devices.</summary>
    public struct ControlNames
    {
        public string Trigger;
        public string Grip;

        /// <summary>Controllers of Meta, HTC, Valve: `OculusTouchController` and the like.</summary>
        public static ControlNames Controllers { get { return new ControlNames { Trigger = "trigger", Grip = "grip" }; } }

        /// <summary>Hands by the interaction profile of Microsoft: `HoloLensHand`.</summary>
        public static ControlNames HoloLensHands { get { return new ControlNames { Trigger = "select", Grip = "squeeze" }; } }
    }

    /// <summary>Reads devices. Allocates nothing per frame. Dispose of it to give the actions back.</summary>
    public sealed class ControlReader : IDeviceReader, IGaze, IDisposable
    {
        /// <summary>`InputTrackingState`: position and rotation are valid. OpenXR: valid is not yet tracked.</summary>
        private const int PositionValid = 1;
        private const int BothValid = 3;

        private readonly List<InputAction> actions = new List<InputAction>();
        private readonly PoseActions head;
        private readonly PoseActions gaze;
        private readonly InputAction presence;
        private readonly HandActions[] hands;
        private bool hasPresence;

        /// <param name="names">Names of the controls of the hands' devices.</param>
        /// <param name="kind">What those devices are.</param>
        public ControlReader(ControlNames names, InputKind kind = InputKind.Controller)
        {
            Kind = kind;
            head = new PoseActions(this, "<XRHMD>/", "centerEyePosition", "centerEyeRotation");
            gaze = new PoseActions(this, "<EyeGaze>/pose/", "position", "rotation");
            presence = Add("<XRHMD>/userPresence");
            hands = new[] { new HandActions(this, "<XRController>{LeftHand}/", names), new HandActions(this, "<XRController>{RightHand}/", names) };
        }

        public InputKind Kind { get; }

        /// <summary>Bare hands, which are read where there is one; null: there are none.</summary>
        public IHands BareHands { get; set; }

        /// <summary>Joints are wanted so often [ns]: 50 poses are 3 kB.</summary>
        private const long JointsNs = 33_000_000;
        private long jointsAt = long.MinValue;

        /// <summary>Whether the headset is on a head. True until the runtime has said so once: not all of them know.</summary>
        public bool IsOnHead
        {
            get
            {
                bool isPresent = presence.IsPressed();
                hasPresence |= isPresent;
                return isPresent || !hasPresence;
            }
        }

        public void Read(HeadsetReading reading)
        {
            reading.CaptureNs = MonotonicClock.NowNs;
            reading.HeadValidity = head.Judge();
            if (reading.HeadValidity != PoseValidity.NotSeen)
            {
                reading.Head = head.Read();
                reading.HasHead = true;
            }
            reading.HasGaze = TryRead(out reading.Gaze);
            reading.GazeValidity = reading.HasGaze ? PoseValidity.Measured : PoseValidity.NotSeen;
            bool wantsJoints = reading.CaptureNs - jointsAt >= JointsNs || jointsAt == long.MinValue;
            if (wantsJoints) jointsAt = reading.CaptureNs;
            for (int side = 0; side < 2; side++)
            {
                InputReading input = reading.Inputs[side];
                bool isBare = BareHands != null && BareHands.IsSupported && BareHands.TryRead((Side)side, wantsJoints, input);
                if (isBare) input.Buttons |= hands[side].ReadButtons(ButtonBits.Stop); // a hand that holds a controller may be tracked as bare
                else hands[side].Read(input, Kind);
            }
        }

        /// <summary>Read the buttons of the e-stop and nothing else: no fault of another control keeps it from being pressed.</summary>
        public void ReadStops(HeadsetReading reading)
        {
            reading.CaptureNs = MonotonicClock.NowNs;
            for (int side = 0; side < 2; side++)
            {
                reading.Inputs[side].Clear(); // it points at nothing
                reading.Inputs[side].Buttons = hands[side].ReadButtons(ButtonBits.Stop);
            }
        }

        public bool TryRead(out RigidTransform T_tracking_gaze)
        {
            bool isSeen = gaze.Judge() == PoseValidity.Measured;
            T_tracking_gaze = isSeen ? gaze.Read() : RigidTransform.Identity;
            return isSeen;
        }

        public void Dispose()
        {
            foreach (InputAction action in actions) action.Dispose();
            actions.Clear();
        }

        private InputAction Add(string path)
        {
            InputAction action = new InputAction(binding: path);
            action.Enable();
            actions.Add(action);
            return action;
        }

        /// <summary>A pose, and what the runtime knows of it.</summary>
        private sealed class PoseActions
        {
            private readonly InputAction position;
            private readonly InputAction rotation;
            private readonly InputAction isTracked;
            private readonly InputAction state;

            public PoseActions(ControlReader reader, string device, string position, string rotation)
            {
                this.position = reader.Add(device + position);
                this.rotation = reader.Add(device + rotation);
                isTracked = reader.Add(device + "isTracked");
                state = reader.Add(device + "trackingState");
            }

            public PoseValidity Judge()
            {
                int valid = state.ReadValue<int>();
                if (isTracked.IsPressed() && (valid & BothValid) == BothValid) return PoseValidity.Measured;
                return (valid & PositionValid) != 0 ? PoseValidity.Emulated : PoseValidity.NotSeen;
            }

            public Vector3 ReadPosition() { return position.ReadValue<Vector3>(); }

            public Quaternion ReadRotation() { return rotation.ReadValue<Quaternion>(); }

            public RigidTransform Read() { return EnginePoses.ToWire(ReadPosition(), ReadRotation()); }
        }

        private sealed class HandActions
        {
            private readonly PoseActions grip;
            private readonly PoseActions aim;
            private readonly InputAction trigger;
            private readonly InputAction squeeze;
            private readonly KeyValuePair<long, InputAction>[] buttons;

            public HandActions(ControlReader reader, string device, ControlNames names)
            {
                grip = new PoseActions(reader, device, "devicePosition", "deviceRotation");
                aim = new PoseActions(reader, device + "pointer/", "position", "rotation");
                trigger = reader.Add(device + names.Trigger);
                squeeze = reader.Add(device + names.Grip);
                buttons = new[]
                {
                    new KeyValuePair<long, InputAction>(ButtonBits.Trigger, trigger),
                    new KeyValuePair<long, InputAction>(ButtonBits.Squeeze, squeeze),
                    new KeyValuePair<long, InputAction>(ButtonBits.Touchpad, reader.Add(device + "trackpadClicked")),
                    new KeyValuePair<long, InputAction>(ButtonBits.Thumbstick, reader.Add(device + "thumbstickClicked")),
                    new KeyValuePair<long, InputAction>(ButtonBits.Lower, reader.Add(device + "primaryButton")),
                    new KeyValuePair<long, InputAction>(ButtonBits.Upper, reader.Add(device + "secondaryButton")),
                    new KeyValuePair<long, InputAction>(ButtonBits.Menu, reader.Add(device + "menu")),
                };
            }

            public long ReadButtons(long which = -1)
            {
                long bits = 0;
                foreach (KeyValuePair<long, InputAction> one in buttons) if ((one.Key & which) != 0 && one.Value.IsPressed()) bits |= one.Key;
                return bits;
            }

            /// <summary>
            /// A controller is where it is held, looking to where it points: one rigid frame, as well known as the worse of both. A hand is its
            /// grip: the runtime steadies its ray, which turns when the hand moves, and not when it turns.
            /// </summary>
            public void Read(InputReading input, InputKind kind)
            {
                PoseValidity held = grip.Judge();
                PoseValidity aimed = aim.Judge();
                bool isHand = kind == InputKind.Hand;
                if (input.Kind != kind) input.HasPose = false; // that of another device
                input.Clear();
                input.Kind = kind;
                input.Validity = isHand || held < aimed ? held : aimed;
                input.Buttons = ReadButtons();
                if (input.Validity == PoseValidity.NotSeen) return;
                RigidTransform ray = aim.Read();
                input.Pose = grip.Read();
                if (!isHand) input.Pose = new RigidTransform(input.Pose.Position, ray.Rotation);
                input.IsPresent = input.HasPose = true;
                input.Ray = AimRay.Along(ray);
                input.HasRay = aimed != PoseValidity.NotSeen;
                input.Trigger = trigger.ReadValue<float>();
                input.Squeeze = squeeze.ReadValue<float>();
            }
        }
    }
}
