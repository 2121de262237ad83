// Vibration of controllers by the OpenXR plug-in.
using System;
using IrisSession.Interaction;
using UnityEngine.InputSystem;
using UnityEngine.XR.OpenXR.Input;

namespace IrisSession.Unity.Input
{
    /// <summary>Plays pulses. Dispose of it to give the actions back.</summary>
    public sealed class ControllerHaptics : IHaptics, IDisposable
    {
        private readonly InputAction[] motors = { Make("{LeftHand}"), Make("{RightHand}") };

        public void Play(Side side, Pulse pulse)
        {
            OpenXRInput.SendHapticImpulse(motors[(int)side], pulse.Intensity, 0f, pulse.Seconds); // 0: the runtime's own frequency
        }

        public void Dispose()
        {
            foreach (InputAction motor in motors) motor.Dispose();
        }

        private static InputAction Make(string hand)
        {
            InputAction action = new InputAction(type: InputActionType.PassThrough, binding: "<XRController>" + hand + "/haptic");
            action.Enable();
            return action;
        }
    }
}
