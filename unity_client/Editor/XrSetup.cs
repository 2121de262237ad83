// The loader and the features of OpenXR for one platform.
using UnityEditor;
using UnityEditor.XR.Management;
using UnityEditor.XR.Management.Metadata;
using UnityEditor.XR.OpenXR.Features;
using UnityEngine;
using UnityEngine.XR.Management;
using UnityEngine.XR.OpenXR;
using UnityEngine.XR.OpenXR.Features;

namespace IrisSession.Editor
{
    /// <summary>Does what the pages "XR Plug-in Management" and "OpenXR" of the project settings do.</summary>
    public static class XrSetup
    {
        private const string Loader = "UnityEngine.XR.OpenXR.OpenXRLoader";
        private const string Folder = "Assets/XR";
        private const string SettingsPath = Folder + "/XRGeneralSettingsPerBuildTarget.asset";

        public static void EnableLoader(BuildTargetGroup group, SetupReport report)
        {
            if (!EditorBuildSettings.TryGetConfigObject(XRGeneralSettings.k_SettingsKey, out XRGeneralSettingsPerBuildTarget all) || all == null)
            {
                all = ScriptableObject.CreateInstance<XRGeneralSettingsPerBuildTarget>();
                SceneAssets.MakeFolder(Folder);
                AssetDatabase.CreateAsset(all, SettingsPath);
                EditorBuildSettings.AddConfigObject(XRGeneralSettings.k_SettingsKey, all, true);
                report.Change("settings of XR: " + SettingsPath);
            }
            if (!all.HasManagerSettingsForBuildTarget(group)) all.CreateDefaultManagerSettingsForBuildTarget(group);
            if (XRPackageMetadataStore.IsLoaderAssigned(Loader, group)) return;
            if (XRPackageMetadataStore.AssignLoader(all.ManagerSettingsForBuildTarget(group), Loader, group)) report.Change("plug-in provider for " + group + ": OpenXR");
            else report.Leave("Edit > Project Settings > XR Plug-in Management, tab of " + group + ": tick OpenXR");
            EditorUtility.SetDirty(all);
        }

        /// <summary>Enable a feature by its id.</summary>
        public static OpenXRFeature EnableFeature(BuildTargetGroup group, string id, SetupReport report)
        {
            OpenXRFeature feature = FeatureHelpers.GetFeatureWithIdForBuildTarget(group, id);
            Enable(feature, id, group, report);
            return feature;
        }

        /// <summary>Enable a feature by its type, where two have one id: Microsoft's hand interaction and Unity's hand tracking.</summary>
        public static void EnableFeatureOfType(BuildTargetGroup group, string type, SetupReport report)
        {
            OpenXRSettings settings = OpenXRSettings.GetSettingsForBuildTargetGroup(group);
            OpenXRFeature found = null;
            if (settings != null) foreach (OpenXRFeature one in settings.GetFeatures()) if (one.GetType().FullName == type) found = one;
            Enable(found, type, group, report);
        }

        private static void Enable(OpenXRFeature feature, string name, BuildTargetGroup group, SetupReport report)
        {
            if (feature == null)
            {
                report.Leave("Edit > Project Settings > XR Plug-in Management > OpenXR, tab of " + group + ": there is no feature " + name + "; is its package installed?");
                return;
            }
            if (feature.enabled) return;
            feature.enabled = true;
            EditorUtility.SetDirty(feature);
            report.Change("OpenXR feature of " + group + ": " + name);
        }
    }
}
