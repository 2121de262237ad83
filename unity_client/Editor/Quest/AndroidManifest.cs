// The Android manifest of a project: what the app needs beyond what Unity and the plug-ins write at each build.
using System.Xml;

namespace IrisSession.Editor.Quest
{
    /// <summary>
    /// Completes a manifest; what is there stays. `com.oculus.supportedDevices` is not in it: the OpenXR plug-in writes it at each build
    /// from the list of devices of its feature "Meta Quest Support", and two values of one name end the build.
    /// </summary>
    public static class AndroidManifest
    {
        /// <summary>Below Assets. Unity takes it instead of its own main manifest, so it has the activity.</summary>
        public const string File = "Plugins/Android/AndroidManifest.xml";

        /// <summary>The activity of the application entry point "GameActivity".</summary>
        public const string Activity = "com.unity3d.player.UnityPlayerGameActivity";
        public const string SupportedDevices = "com.oculus.supportedDevices";
        private const string Android = "http://schemas.android.com/apk/res/android";
        private const string Tools = "http://schemas.android.com/tools";
        private const string Indent = "    ";

        private static readonly string[] Permissions =
        {
            "android.permission.INTERNET",
            "android.permission.ACCESS_WIFI_STATE", "android.permission.CHANGE_WIFI_MULTICAST_STATE", // sessions announce themselves by broadcast
            "com.oculus.permission.USE_SCENE", // QR codes
            "com.oculus.permission.HAND_TRACKING",
        };

        /// <summary>
        /// Permissions to take pictures, which the app does not: "OpenXR: Meta" 2.4.0 asks for them wherever the room is shown, in a library whose
        /// manifest is merged below this one, and Android would ask the wearer at the first start.
        /// </summary>
        private static readonly string[] Unwanted = { "android.permission.CAMERA", "horizonos.permission.HEADSET_CAMERA", "com.oculus.permission.USE_PASSTHROUGH_CAMERA" };

        /// <summary>Features that the app can do without.</summary>
        private static readonly string[] Features = { "oculus.software.handtracking", "oculus.software.overlay_keyboard" };

        /// <summary>A manifest of Unity 6 with the entry point GameActivity, as its manual has it.</summary>
        private const string Start = @"<?xml version=""1.0"" encoding=""utf-8""?>
<manifest xmlns:android=""http://schemas.android.com/apk/res/android"" xmlns:tools=""http://schemas.android.com/tools"">
    <application>
        <activity android:name=""com.unity3d.player.UnityPlayerGameActivity"" android:theme=""@style/BaseUnityGameActivityTheme"">
            <intent-filter>
                <action android:name=""android.intent.action.MAIN"" />
                <category android:name=""android.intent.category.LAUNCHER"" />
            </intent-filter>
            <meta-data android:name=""unityplayer.UnityActivity"" android:value=""true"" />
            <meta-data android:name=""android.app.lib_name"" android:value=""game"" />
        </activity>
    </application>
</manifest>
";

        /// <summary>Return `existing` with everything that the app needs. Null: a new manifest.</summary>
        public static string Complete(string existing, SetupReport report)
        {
            XmlDocument document = new XmlDocument { PreserveWhitespace = true, XmlResolver = null };
            try
            {
                document.LoadXml((existing ?? Start).Replace("\r\n", "\n"));
            }
            catch (XmlException error)
            {
                report.Leave(File + " is no XML (" + error.Message + "): mend or remove it, and choose the command again");
                return existing;
            }
            XmlElement manifest = document.DocumentElement;
            foreach (string name in Permissions) Add(manifest, "uses-permission", name, null, null, report);
            foreach (string name in Unwanted) Remove(manifest, name, report);
            foreach (string name in Features) Add(manifest, "uses-feature", name, "required", "false", report);
            XmlElement application = Find(manifest, "application", null);
            XmlElement activity = application == null ? null : Find(application, "activity", Activity);
            if (activity == null) report.Leave(File + " has no activity " + Activity + ": remove the file, or set your activity as Unity's manual says");
            else Add(activity, "meta-data", "com.oculus.vr.focusaware", "value", "true", report);
            if (application != null && Find(application, "meta-data", SupportedDevices) != null)
                report.Leave("remove " + SupportedDevices + " from " + File + ": the OpenXR plug-in writes it, and two of them end the build");
            return document.OuterXml;
        }

        private static void Add(XmlElement parent, string kind, string name, string key, string value, SetupReport report)
        {
            XmlElement found = Find(parent, kind, name);
            if (found != null)
            {
                if (key != null && found.GetAttribute(key, Android) != value) report.Leave(File + ": " + name + " has " + key + " '" + found.GetAttribute(key, Android) + "', the app expects '" + value + "'");
                return;
            }
            XmlElement added = parent.OwnerDocument.CreateElement(kind);
            SetAttribute(added, "name", name);
            if (key != null) SetAttribute(added, key, value);
            Append(parent, added);
            report.Change(File + ": " + name);
        }

        /// <summary>Keep a permission of plug-ins out of the app, unless the project asks for it itself.</summary>
        private static void Remove(XmlElement manifest, string permission, SetupReport report)
        {
            if (Find(manifest, "uses-permission", permission) != null) return;
            XmlElement added = manifest.OwnerDocument.CreateElement("uses-permission");
            SetAttribute(added, "name", permission);
            XmlAttribute node = manifest.OwnerDocument.CreateAttribute("tools", "node", Tools);
            node.Value = "remove";
            added.Attributes.Append(node);
            Append(manifest, added);
            report.Change(File + ": without " + permission);
        }

        private static XmlElement Find(XmlElement parent, string kind, string name)
        {
            foreach (XmlNode one in parent.ChildNodes)
                if (one is XmlElement element && element.Name == kind && (name == null || element.GetAttribute("name", Android) == name)) return element;
            return null;
        }

        private static void SetAttribute(XmlElement element, string name, string value)
        {
            XmlAttribute added = element.OwnerDocument.CreateAttribute("android", name, Android);
            added.Value = value;
            element.Attributes.Append(added);
        }

        /// <summary>Append on a line of its own.</summary>
        private static void Append(XmlElement parent, XmlElement added)
        {
            string line = "\n";
            for (XmlNode one = parent; one.ParentNode is XmlElement; one = one.ParentNode) line += Indent;
            XmlNode end = parent.LastChild as XmlWhitespace;
            if (end == null) parent.AppendChild(end = parent.OwnerDocument.CreateWhitespace(line));
            parent.InsertBefore(parent.OwnerDocument.CreateWhitespace(line + Indent), end);
            parent.InsertBefore(added, end);
        }
    }
}
