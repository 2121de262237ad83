// XR Plug-in Management and OpenXR in the editor: loaders and features for each platform.
using System.Collections.Generic;
using UnityEditor;
using UnityEngine.XR.Management;
using UnityEngine.XR.OpenXR.Features;

namespace UnityEngine.XR.Management
{
    public sealed class XRManagerSettings : ScriptableObject
    {
        internal readonly List<string> Loaders = new List<string>();
    }

    public class XRGeneralSettings : ScriptableObject
    {
        public static string k_SettingsKey = "com.unity.xr.management.loader_settings";
    }
}

namespace UnityEditor.XR.Management
{
    public class XRGeneralSettingsPerBuildTarget : UnityEngine.ScriptableObject
    {
        private readonly Dictionary<BuildTargetGroup, XRManagerSettings> managers = new Dictionary<BuildTargetGroup, XRManagerSettings>();

        public bool HasManagerSettingsForBuildTarget(BuildTargetGroup targetGroup) { return managers.ContainsKey(targetGroup); }

        public void CreateDefaultManagerSettingsForBuildTarget(BuildTargetGroup targetGroup) { managers[targetGroup] = new XRManagerSettings(); }

        public XRManagerSettings ManagerSettingsForBuildTarget(BuildTargetGroup targetGroup) { return managers.TryGetValue(targetGroup, out XRManagerSettings found) ? found : null; }
    }
}

namespace UnityEditor.XR.Management.Metadata
{
    public class XRPackageMetadataStore
    {
        public static bool IsLoaderAssigned(string loaderTypeName, BuildTargetGroup buildTargetGroup)
        {
            EditorBuildSettings.TryGetConfigObject(XRGeneralSettings.k_SettingsKey, out XRGeneralSettingsPerBuildTarget all);
            XRManagerSettings manager = all == null ? null : all.ManagerSettingsForBuildTarget(buildTargetGroup);
            return manager != null && manager.Loaders.Contains(loaderTypeName);
        }

        public static bool AssignLoader(XRManagerSettings settings, string loaderTypeName, BuildTargetGroup buildTargetGroup)
        {
            if (settings == null) return false;
            settings.Loaders.Add(loaderTypeName);
            return true;
        }
    }
}

namespace UnityEngine.XR.OpenXR
{
    public class OpenXRSettings : ScriptableObject
    {
        internal static readonly Dictionary<BuildTargetGroup, OpenXRSettings> All = new Dictionary<BuildTargetGroup, OpenXRSettings>();
        internal readonly List<OpenXRFeature> Features = new List<OpenXRFeature>();

        public static OpenXRSettings GetSettingsForBuildTargetGroup(BuildTargetGroup buildTargetGroup) { return All.TryGetValue(buildTargetGroup, out OpenXRSettings found) ? found : null; }

        public OpenXRFeature[] GetFeatures() { return Features.ToArray(); }
    }
}

namespace UnityEngine.XR.OpenXR.Features
{
    public abstract class OpenXRFeature : ScriptableObject
    {
        internal string Id = "";

        public bool enabled { get; set; }
    }

    public abstract class OpenXRInteractionFeature : OpenXRFeature
    {
    }
}

namespace UnityEngine.XR.OpenXR.Features.Interactions
{
    public class MicrosoftHandInteraction : OpenXRInteractionFeature
    {
    }
}

namespace UnityEngine.XR.Hands.OpenXR
{
    public class HandTracking : OpenXRFeature
    {
    }
}

namespace UnityEngine.XR.OpenXR.Features.MetaQuestSupport
{
    public class MetaQuestFeature : OpenXRFeature
    {
        internal struct TargetDevice
        {
            public string visibleName;
            public bool enabled;
        }

        internal List<TargetDevice> targetDevices = new List<TargetDevice>
        {
            new TargetDevice { visibleName = "Quest", enabled = true }, new TargetDevice { visibleName = "Quest 2", enabled = true },
            new TargetDevice { visibleName = "Quest Pro", enabled = true }, new TargetDevice { visibleName = "Quest 3", enabled = true }, new TargetDevice { visibleName = "Quest 3S", enabled = true },
        };
    }
}

namespace UnityEditor.XR.OpenXR.Features
{
    /// <summary>Features that packages have: RefreshFeatures makes those of a platform, all disabled.</summary>
    public static class FeatureHelpers
    {
        /// <summary>Ids without a type of their own here.</summary>
        internal static readonly Dictionary<BuildTargetGroup, string[]> Ids = new Dictionary<BuildTargetGroup, string[]>();

        private const string HandId = "com.unity.openxr.feature.input.handtracking";

        public static void RefreshFeatures(BuildTargetGroup group)
        {
            if (UnityEngine.XR.OpenXR.OpenXRSettings.All.ContainsKey(group)) return;
            UnityEngine.XR.OpenXR.OpenXRSettings settings = new UnityEngine.XR.OpenXR.OpenXRSettings();
            settings.Features.Add(new UnityEngine.XR.OpenXR.Features.Interactions.MicrosoftHandInteraction { Id = HandId });
            settings.Features.Add(new UnityEngine.XR.Hands.OpenXR.HandTracking { Id = HandId });
            settings.Features.Add(new UnityEngine.XR.OpenXR.Features.MetaQuestSupport.MetaQuestFeature { Id = "com.unity.openxr.feature.metaquest" });
            foreach (string id in Ids[group]) settings.Features.Add(new Feature { Id = id });
            UnityEngine.XR.OpenXR.OpenXRSettings.All[group] = settings;
        }

        /// <summary>The first one with this id, as the manual says: several can have it.</summary>
        public static OpenXRFeature GetFeatureWithIdForBuildTarget(BuildTargetGroup buildTargetGroup, string featureId)
        {
            foreach (OpenXRFeature one in UnityEngine.XR.OpenXR.OpenXRSettings.GetSettingsForBuildTargetGroup(buildTargetGroup).GetFeatures()) if (one.Id == featureId) return one;
            return null;
        }

        private sealed class Feature : OpenXRFeature
        {
        }
    }
}
