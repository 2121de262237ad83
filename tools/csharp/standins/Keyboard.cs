// The keyboard of the system: tests type with it.
using Standins;

namespace UnityEngine
{
    public enum TouchScreenKeyboardType
    {
        Default = 0,
    }

    public class TouchScreenKeyboard
    {
        public enum Status
        {
            Visible = 0,
            Done = 1,
            Canceled = 2,
            LostFocus = 3,
        }

        internal static bool IsThere;

        /// <summary>The one that was opened last, null before the first.</summary>
        internal static TouchScreenKeyboard Newest;

        internal TouchScreenKeyboard() { }

        public static bool isSupported { get { return IsThere; } }

        public string text { get; set; }

        public Status status { get; internal set; }

        public static TouchScreenKeyboard Open(string text, TouchScreenKeyboardType keyboardType, bool autocorrection, bool multiline, bool secure, bool alert, string textPlaceholder, int characterLimit)
        {
            Engine.CheckThread();
            return Newest = new TouchScreenKeyboard { text = text };
        }
    }
}
