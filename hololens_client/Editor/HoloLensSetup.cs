// The menu command that makes a project one for HoloLens 2: settings, capabilities, features of OpenXR.
using IrisSession.Editor;
using UnityEditor;
using UnityEditor.Build;
using UnityEditor.XR.OpenXR.Features;
using UnityEngine.Rendering;

namespace IrisSession.HoloLens.Editor
{
    /// <summary>Names of the product, the company and the package stay as they are.</summary>
    public static class HoloLensSetup
    {
        private const string Title = "Set Up Project for HoloLens 2";

        private static readonly PlayerSettings.WSACapability[] Capabilities =
        {
            PlayerSettings.WSACapability.InternetClient,
            PlayerSettings.WSACapability.InternetClientServer, // beacons come from others
            PlayerSettings.WSACapability.PrivateNetworkClientServer,
            PlayerSettings.WSACapability.WebCam, // QR codes
            PlayerSettings.WSACapability.GazeInput,
            PlayerSettings.WSACapability.SpatialPerception,
        };

        private static readonly string[] Features =
        {
            "com.microsoft.openxr.feature.hololens",
            "com.microsoft.openxr.feature.handtracking",
            "com.unity.openxr.feature.input.eyetracking",
        };

        [MenuItem("Iris Session/" + Title, false, 2)]
        public static void SetUp() { SetupReport.Run(Title, Apply); }

        private static void Apply(SetupReport report)
        {
            if (!PlayerSetup.CanBuild(BuildTargetGroup.WSA, BuildTarget.WSAPlayer, "Universal Windows Platform Build Support", report)) return;
            PlayerSetup.Apply(NamedBuildTarget.WindowsStoreApps, BuildTarget.WSAPlayer, GraphicsDeviceType.Direct3D11, report);
            foreach (PlayerSettings.WSACapability one in Capabilities)
                report.Set("capability " + one, PlayerSettings.WSA.GetCapability(one), true, value => PlayerSettings.WSA.SetCapability(one, value));
            report.Set("device family Holographic", PlayerSettings.WSA.GetTargetDeviceFamily(PlayerSettings.WSATargetFamily.Holographic), true,
                value => PlayerSettings.WSA.SetTargetDeviceFamily(PlayerSettings.WSATargetFamily.Holographic, value));
            report.Set("architecture", EditorUserBuildSettings.wsaArchitecture, "ARM64", value => EditorUserBuildSettings.wsaArchitecture = value);
            report.Set("build type", EditorUserBuildSettings.wsaUWPBuildType, WSAUWPBuildType.D3D, value => EditorUserBuildSettings.wsaUWPBuildType = value);
            XrSetup.EnableLoader(BuildTargetGroup.WSA, report);
            FeatureHelpers.RefreshFeatures(BuildTargetGroup.WSA);
            foreach (string id in Features) XrSetup.EnableFeature(BuildTargetGroup.WSA, id, report);
            XrSetup.EnableFeatureOfType(BuildTargetGroup.WSA, "UnityEngine.XR.OpenXR.Features.Interactions.MicrosoftHandInteraction", report);
            AssetDatabase.SaveAssets();
            PlayerSetup.SwitchTo(BuildTargetGroup.WSA, BuildTarget.WSAPlayer, report);
        }
    }
}
