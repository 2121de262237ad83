// Controls of the Input System, by the paths of their bindings: tests set values, actions that are enabled read them.
using System;
using System.Collections.Generic;
using Standins;

namespace Standins
{
    /// <summary>What devices report, and pulses that were asked for.</summary>
    public static class Controls
    {
        internal static readonly Dictionary<string, object> Values = new Dictionary<string, object>();

        /// <summary>Binding of the action, amplitude and seconds of every pulse.</summary>
        public static readonly List<string> Pulses = new List<string>();

        public static void Set<T>(string path, T value) where T : struct { Values[path] = value; }

        public static void Clear()
        {
            Values.Clear();
            Pulses.Clear();
        }
    }
}

namespace UnityEngine.InputSystem
{
    public enum InputActionType
    {
        Value = 0,
        Button = 1,
        PassThrough = 2,
    }

    public sealed class InputAction : IDisposable
    {
        private readonly string path;

        public InputAction(string name = null, InputActionType type = default, string binding = null, string interactions = null, string processors = null, string expectedControlType = null)
        {
            path = binding;
        }

        public bool enabled { get; internal set; }

        internal string Path { get { return path; } }

        public void Enable() { Engine.CheckThread(); enabled = true; }

        public void Disable() { enabled = false; }

        public void Dispose() { enabled = false; }

        public TValue ReadValue<TValue>() where TValue : struct
        {
            Engine.CheckThread();
            if (!enabled || !Controls.Values.TryGetValue(path, out object value)) return default;
            if (!(value is TValue typed)) throw new InvalidOperationException(path + " is a " + value.GetType().Name); // as the engine does
            return typed;
        }

        public bool IsPressed() { return enabled && Controls.Values.TryGetValue(path, out object value) && value is float share && share >= 0.5f; }
    }
}

namespace UnityEngine.XR.OpenXR.Input
{
    public static class OpenXRInput
    {
        public static void SendHapticImpulse(UnityEngine.InputSystem.InputAction action, float amplitude, float frequency, float duration, UnityEngine.InputSystem.InputDevice inputDevice = null)
        {
            Controls.Pulses.Add(action.Path + " " + amplitude + " " + duration);
        }
    }
}

namespace UnityEngine.InputSystem
{
    public class InputDevice
    {
    }
}
