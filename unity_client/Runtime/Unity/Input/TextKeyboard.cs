// The keyboard of the system, for addresses and join codes. On Quest it needs the feature `oculus.software.overlay_keyboard` in the manifest.
using UnityEngine;

namespace IrisSession.Unity.Input
{
    /// <summary>Opens a keyboard, and takes what was typed.</summary>
    public sealed class TextKeyboard
    {
        private const int MaxLength = 2000;
        private TouchScreenKeyboard keyboard;

        /// <summary>False where the system has none: on computers.</summary>
        public static bool IsSupported { get { return TouchScreenKeyboard.isSupported; } }

        public bool IsOpen { get { return keyboard != null; } }

        /// <summary>Show it.</summary>
        /// <param name="hint">What is to be typed.</param>
        public void Open(string hint)
        {
            keyboard = TouchScreenKeyboard.Open("", TouchScreenKeyboardType.Default, false, false, false, false, hint, MaxLength);
        }

        /// <summary>Return what was typed, once; null while it is typed, and when the person has gone back.</summary>
        public string TakeText()
        {
            if (keyboard == null || keyboard.status == TouchScreenKeyboard.Status.Visible) return null;
            string text = keyboard.status == TouchScreenKeyboard.Status.Done ? keyboard.text : "";
            keyboard = null;
            return string.IsNullOrWhiteSpace(text) ? null : text.Trim();
        }
    }
}
