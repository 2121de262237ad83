// The menu command that makes a project one for Quest 3: packages, settings, features of OpenXR, the Android manifest.
using System;
using System.IO;
using UnityEditor;
using UnityEditor.Build;
using UnityEditor.XR.OpenXR.Features;
using UnityEngine;
using UnityEngine.Rendering;
using UnityEngine.XR.OpenXR.Features;

namespace IrisSession.Editor.Quest
{
    /// <summary>Names of the product and of the company stay as they are.</summary>
    public static class QuestSetup
    {
        private const string Title = "Set Up Project for Quest 3";

        private static readonly string[] Devices = { "Quest 3", "Quest 3S" };

        private static readonly string[] Features =
        {
            "com.unity.openxr.feature.arfoundation-meta-session",
            "com.unity.openxr.feature.arfoundation-meta-camera", // passthrough, which is a composition layer
            "com.unity.openxr.feature.compositionlayers",
            "com.unity.openxr.feature.arfoundation-spatialentities-setup",
            "com.unity.openxr.feature.arfoundation-spatialentities-marker", // QR codes, which it looks for by default
            "com.unity.openxr.feature.input.oculustouch",
            "com.unity.openxr.feature.input.metaquestplus",
            "com.unity.openxr.feature.input.metahandtrackingaim",
        };

        [MenuItem("Iris Session/" + Title, false, 1)]
        public static void SetUp() { SetupReport.Run(Title, Apply); }

        private static void Apply(SetupReport report)
        {
            if (!PlayerSetup.CanBuild(BuildTargetGroup.Android, BuildTarget.Android, "Android Build Support with OpenJDK and Android SDK & NDK Tools", report)) return;
            if (!PackageList.Install("quest-3.manifest.json", report)) return;
            PlayerSetup.Apply(NamedBuildTarget.Android, BuildTarget.Android, GraphicsDeviceType.Vulkan, report);
            SetAndroid(report);
            CheckId(report);
            WriteManifest(report);
            XrSetup.EnableLoader(BuildTargetGroup.Android, report);
            FeatureHelpers.RefreshFeatures(BuildTargetGroup.Android);
            OpenXRFeature quest = XrSetup.EnableFeature(BuildTargetGroup.Android, "com.unity.openxr.feature.metaquest", report);
            if (quest != null) SetTargetDevices(quest, report);
            foreach (string id in Features) XrSetup.EnableFeature(BuildTargetGroup.Android, id, report);
            XrSetup.EnableFeatureOfType(BuildTargetGroup.Android, "UnityEngine.XR.Hands.OpenXR.HandTracking", report);
            AssetDatabase.SaveAssets();
            Debug.Log("Iris Session: files of the app on a headset: /sdcard/Android/data/" + PlayerSettings.GetApplicationIdentifier(NamedBuildTarget.Android) + "/files");
            PlayerSetup.SwitchTo(BuildTargetGroup.Android, BuildTarget.Android, report);
        }

        private static void SetAndroid(SetupReport report)
        {
            report.Set("architectures", PlayerSettings.Android.targetArchitectures, AndroidArchitecture.ARM64, value => PlayerSettings.Android.targetArchitectures = value);
            if (PlayerSettings.Android.minSdkVersion < AndroidSdkVersions.AndroidApiLevel32)
                report.Set("minimum API level", PlayerSettings.Android.minSdkVersion, AndroidSdkVersions.AndroidApiLevel32, value => PlayerSettings.Android.minSdkVersion = value);
            report.Set("internet permission is required", PlayerSettings.Android.forceInternetPermission, true, value => PlayerSettings.Android.forceInternetPermission = value);
            report.Set("application entry point", PlayerSettings.Android.applicationEntry, AndroidApplicationEntry.GameActivity, value => PlayerSettings.Android.applicationEntry = value);
            report.Set("orientation", PlayerSettings.defaultInterfaceOrientation, UIOrientation.LandscapeLeft, value => PlayerSettings.defaultInterfaceOrientation = value);
            report.Set("texture compression", EditorUserBuildSettings.androidBuildSubtarget, MobileTextureSubtarget.ASTC, value => EditorUserBuildSettings.androidBuildSubtarget = value);
        }

        /// <summary>Two apps of the template would be one to a headset. An id is for good, so a person chooses it.</summary>
        private static void CheckId(SetupReport report)
        {
            string id = PlayerSettings.GetApplicationIdentifier(NamedBuildTarget.Android);
            if (!id.Contains(".unity.template.")) return;
            report.Leave("Edit > Project Settings > Player, Android tab > Other Settings > Identification: tick Override Default Package Name and set an id of your own, such as org.yourlab.iris; " + id + " is that of Unity's template");
        }

        private static void WriteManifest(SetupReport report)
        {
            string path = Path.Combine(Application.dataPath, AndroidManifest.File);
            string existing = File.Exists(path) ? File.ReadAllText(path) : null;
            string complete = AndroidManifest.Complete(existing, report);
            if (complete == existing || complete == existing?.Replace("\r\n", "\n")) return;
            Directory.CreateDirectory(Path.GetDirectoryName(path));
            File.WriteAllText(path, complete);
            AssetDatabase.ImportAsset("Assets/" + AndroidManifest.File);
        }

        /// <summary>Let the manifest name these devices alone: by default it names all, and asks for the eye tracking of a Quest Pro.</summary>
        private static void SetTargetDevices(OpenXRFeature quest, SetupReport report)
        {
            SerializedObject settings = new SerializedObject(quest);
            SerializedProperty devices = settings.FindProperty("targetDevices"); // no public member: where it is gone, it is a step by hand
            int found = 0;
            for (int i = 0; devices != null && i < devices.arraySize; i++)
            {
                SerializedProperty name = devices.GetArrayElementAtIndex(i).FindPropertyRelative("visibleName");
                SerializedProperty enabled = devices.GetArrayElementAtIndex(i).FindPropertyRelative("enabled");
                if (name == null || enabled == null) continue;
                bool isWanted = Array.IndexOf(Devices, name.stringValue) >= 0;
                found += isWanted ? 1 : 0;
                report.Set("app for " + name.stringValue, enabled.boolValue, isWanted, value => enabled.boolValue = value);
            }
            settings.ApplyModifiedProperties();
            if (found == Devices.Length) return;
            report.Leave("Edit > Project Settings > XR Plug-in Management > OpenXR, Android tab, gear of 'Meta Quest Support': tick " + string.Join(" and ", Devices) + " alone");
        }
    }
}
