// Settings of the player and of builds: what they begin with, and what commands set.
using System.Collections.Generic;
using UnityEngine;
using UnityEngine.Rendering;

namespace UnityEditor
{
    public enum BuildTargetGroup
    {
        Standalone = 1,
        Android = 7,
        WSA = 14,
    }

    public enum BuildTarget
    {
        Android = 13,
        StandaloneWindows64 = 19,
        WSAPlayer = 21,
    }

    public enum ScriptingImplementation
    {
        Mono2x = 0,
        IL2CPP = 1,
    }

    public enum ManagedStrippingLevel
    {
        Disabled = 0,
        Low = 1,
        Medium = 2,
        High = 3,
        Minimal = 4,
    }

    public enum AndroidArchitecture : uint
    {
        None = 0,
        ARMv7 = 1,
        ARM64 = 2,
    }

    public enum AndroidSdkVersions
    {
        AndroidApiLevelAuto = 0,
        AndroidApiLevel26 = 26,
        AndroidApiLevel32 = 32,
        AndroidApiLevel34 = 34,
    }

    public enum AndroidApplicationEntry : uint
    {
        Activity = 1,
        GameActivity = 2,
    }

    public enum MobileTextureSubtarget
    {
        Generic = 0,
        ASTC = 6,
    }

    public enum UIOrientation
    {
        Portrait = 0,
        LandscapeRight = 2,
        LandscapeLeft = 3,
        AutoRotation = 4,
    }

    public enum WSAUWPBuildType
    {
        XAML = 0,
        D3D = 1,
        ExecutableOnly = 2,
    }

    public sealed class PlayerSettings : Object
    {
        private static readonly Dictionary<string, ScriptingImplementation> Backends = new Dictionary<string, ScriptingImplementation>();
        private static readonly Dictionary<string, ManagedStrippingLevel> Stripping = new Dictionary<string, ManagedStrippingLevel>();
        private static readonly Dictionary<BuildTarget, GraphicsDeviceType[]> Graphics = new Dictionary<BuildTarget, GraphicsDeviceType[]>();
        private static readonly HashSet<BuildTarget> OwnGraphics = new HashSet<BuildTarget>();

        public static ColorSpace colorSpace { get; set; }

        public static bool runInBackground { get; set; }

        public static UIOrientation defaultInterfaceOrientation { get; set; }

        public static ScriptingImplementation GetScriptingBackend(Build.NamedBuildTarget buildTarget) { return Backends.TryGetValue(buildTarget.TargetName, out var found) ? found : ScriptingImplementation.Mono2x; }

        public static void SetScriptingBackend(Build.NamedBuildTarget buildTarget, ScriptingImplementation backend) { Backends[buildTarget.TargetName] = backend; }

        public static ManagedStrippingLevel GetManagedStrippingLevel(Build.NamedBuildTarget buildTarget) { return Stripping.TryGetValue(buildTarget.TargetName, out var found) ? found : ManagedStrippingLevel.Minimal; }

        public static void SetManagedStrippingLevel(Build.NamedBuildTarget buildTarget, ManagedStrippingLevel level) { Stripping[buildTarget.TargetName] = level; }

        public static bool GetUseDefaultGraphicsAPIs(BuildTarget platform) { return !OwnGraphics.Contains(platform); }

        public static void SetUseDefaultGraphicsAPIs(BuildTarget platform, bool automatic)
        {
            if (automatic) OwnGraphics.Remove(platform);
            else OwnGraphics.Add(platform);
        }

        public static GraphicsDeviceType[] GetGraphicsAPIs(BuildTarget platform)
        {
            if (Graphics.TryGetValue(platform, out GraphicsDeviceType[] found)) return found;
            return platform == BuildTarget.Android ? new[] { GraphicsDeviceType.Vulkan, GraphicsDeviceType.OpenGLES3 } : new[] { GraphicsDeviceType.Direct3D12, GraphicsDeviceType.Direct3D11 };
        }

        public static void SetGraphicsAPIs(BuildTarget platform, GraphicsDeviceType[] apis) { Graphics[platform] = apis; }

        public static string GetApplicationIdentifier(Build.NamedBuildTarget buildTarget) { return Identifier; }

        internal static string Identifier;

        internal static void Reset()
        {
            Backends.Clear();
            Stripping.Clear();
            Graphics.Clear();
            OwnGraphics.Clear();
            colorSpace = ColorSpace.Gamma;
            Identifier = "com.DefaultCompany.Lab";
            runInBackground = Android.forceInternetPermission = false;
            defaultInterfaceOrientation = UIOrientation.AutoRotation;
            Android.targetArchitectures = AndroidArchitecture.ARMv7 | AndroidArchitecture.ARM64;
            Android.minSdkVersion = AndroidSdkVersions.AndroidApiLevel26;
            Android.applicationEntry = AndroidApplicationEntry.Activity;
            WSA.Capabilities.Clear();
            WSA.Families.Clear();
            EditorUserBuildSettings.Reset();
            BuildPipeline.Modules.Clear();
            BuildPipeline.Modules.UnionWith(new[] { BuildTarget.Android, BuildTarget.WSAPlayer, BuildTarget.StandaloneWindows64 });
        }

        public class Android
        {
            public static AndroidArchitecture targetArchitectures { get; set; }

            public static AndroidSdkVersions minSdkVersion { get; set; }

            public static bool forceInternetPermission { get; set; }

            public static AndroidApplicationEntry applicationEntry { get; set; }
        }

        public enum WSACapability
        {
            InternetClient = 1,
            InternetClientServer = 2,
            PrivateNetworkClientServer = 5,
            WebCam = 9,
            Microphone = 11,
            SpatialPerception = 23,
            GazeInput = 37,
        }

        public enum WSATargetFamily
        {
            Desktop = 0,
            Holographic = 3,
        }

        public sealed class WSA
        {
            internal static readonly HashSet<WSACapability> Capabilities = new HashSet<WSACapability>();
            internal static readonly HashSet<WSATargetFamily> Families = new HashSet<WSATargetFamily>();

            public static void SetCapability(WSACapability capability, bool value)
            {
                if (value) Capabilities.Add(capability);
                else Capabilities.Remove(capability);
            }

            public static bool GetCapability(WSACapability capability) { return Capabilities.Contains(capability); }

            public static void SetTargetDeviceFamily(WSATargetFamily family, bool value)
            {
                if (value) Families.Add(family);
                else Families.Remove(family);
            }

            public static bool GetTargetDeviceFamily(WSATargetFamily family) { return Families.Contains(family); }
        }
    }

    public class EditorUserBuildSettings : Object
    {
        public static BuildTarget activeBuildTarget { get; internal set; }

        public static MobileTextureSubtarget androidBuildSubtarget { get; set; }

        public static string wsaArchitecture { get; set; }

        public static WSAUWPBuildType wsaUWPBuildType { get; set; }

        public static bool SwitchActiveBuildTarget(BuildTargetGroup targetGroup, BuildTarget target)
        {
            activeBuildTarget = target;
            return true;
        }

        internal static void Reset()
        {
            activeBuildTarget = BuildTarget.StandaloneWindows64;
            androidBuildSubtarget = MobileTextureSubtarget.Generic;
            wsaArchitecture = "x64";
            wsaUWPBuildType = WSAUWPBuildType.XAML;
        }
    }

    public class BuildPipeline
    {
        /// <summary>Platforms whose modules are installed.</summary>
        internal static readonly HashSet<BuildTarget> Modules = new HashSet<BuildTarget>();

        public static bool IsBuildTargetSupported(BuildTargetGroup buildTargetGroup, BuildTarget target) { return Modules.Contains(target); }
    }
}

namespace UnityEditor.Build
{
    public readonly struct NamedBuildTarget
    {
        public static readonly NamedBuildTarget Android = new NamedBuildTarget("Android");
        public static readonly NamedBuildTarget WindowsStoreApps = new NamedBuildTarget("Windows Store Apps");

        private NamedBuildTarget(string name)
        {
            TargetName = name;
        }

        public string TargetName { get; }
    }
}
