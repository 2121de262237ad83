// Settings of the player that all headsets share.
using UnityEditor;
using UnityEditor.Build;
using UnityEngine;
using UnityEngine.Rendering;

namespace IrisSession.Editor
{
    public static class PlayerSetup
    {
        /// <summary>Check that this Unity can build for a platform. False: a module is missing.</summary>
        public static bool CanBuild(BuildTargetGroup group, BuildTarget target, string module, SetupReport report)
        {
            if (BuildPipeline.IsBuildTargetSupported(group, target)) return true;
            report.Leave("Unity Hub > Installs > gear of this editor > Add modules: " + module + "; then start Unity and choose the command again");
            return false;
        }

        /// <summary>Set what does not depend on the headset.</summary>
        public static void Apply(NamedBuildTarget build, BuildTarget target, GraphicsDeviceType graphics, SetupReport report)
        {
            report.Set("colour space", PlayerSettings.colorSpace, ColorSpace.Linear, value => PlayerSettings.colorSpace = value);
            report.Set("run in background", PlayerSettings.runInBackground, true, value => PlayerSettings.runInBackground = value); // under the menu of the system
            report.Set("scripting backend", PlayerSettings.GetScriptingBackend(build), ScriptingImplementation.IL2CPP, value => PlayerSettings.SetScriptingBackend(build, value));
            // Plug-ins find features by reflection: what only that reaches is removed at High. Our own code needs no link.xml.
            if (PlayerSettings.GetManagedStrippingLevel(build) == ManagedStrippingLevel.High)
                report.Set("managed stripping", ManagedStrippingLevel.High, ManagedStrippingLevel.Medium, value => PlayerSettings.SetManagedStrippingLevel(build, value));
            report.Set("automatic graphics API", PlayerSettings.GetUseDefaultGraphicsAPIs(target), false, value => PlayerSettings.SetUseDefaultGraphicsAPIs(target, value));
            GraphicsDeviceType[] now = PlayerSettings.GetGraphicsAPIs(target);
            if (now.Length != 1 || now[0] != graphics)
                report.Set("graphics API", string.Join(", ", now), graphics.ToString(), _ => PlayerSettings.SetGraphicsAPIs(target, new[] { graphics }));
            if (GraphicsSettings.currentRenderPipeline == null)
                report.Leave("the shaders need the Universal Render Pipeline: make the project from the template 'Universal 3D' ('3D (URP)' in Unity 2022.3)");
        }

        /// <summary>Switch to the platform, last: Unity imports and compiles again after the command.</summary>
        public static void SwitchTo(BuildTargetGroup group, BuildTarget target, SetupReport report)
        {
            report.Set("platform", EditorUserBuildSettings.activeBuildTarget, target, value => EditorUserBuildSettings.SwitchActiveBuildTarget(group, value));
        }
    }
}
