// The menu commands on stand-ins of the editor: what a project has after them, and that a second run changes nothing.
using System;
using System.Collections.Generic;
using System.IO;
using System.Linq;
using System.Text.RegularExpressions;
using System.Xml;
using IrisSession.Editor;
using IrisSession.Editor.Quest;
using IrisSession.Editor.QuestScene;
using IrisSession.HoloLens;
using IrisSession.HoloLens.Editor;
using IrisSession.Unity.App;
using IrisSession.Unity.ArFoundation;
using IrisSession.Unity.Input;
using NUnit.Framework;
using Standins;
using Unity.XR.CoreUtils;
using UnityEditor;
using UnityEditor.Build;
using UnityEditor.XR.OpenXR.Features;
using UnityEngine;
using UnityEngine.InputSystem.XR;
using UnityEngine.Rendering;
using UnityEngine.XR.ARFoundation;
using UnityEngine.XR.OpenXR;
using UnityEngine.XR.OpenXR.Features;
using UnityEngine.XR.OpenXR.Features.MetaQuestSupport;
using MicrosoftMarkerManager = Microsoft.MixedReality.OpenXR.ARMarkerManager;

namespace IrisSession.Unity.StandinTests
{
    [TestFixture]
    public sealed class EditorTests
    {
        private const string Loader = "UnityEngine.XR.OpenXR.OpenXRLoader";
        private string folder;

        [SetUp]
        public void Begin()
        {
            folder = Path.Combine(Path.GetTempPath(), Path.GetRandomFileName());
            Directory.CreateDirectory(folder);
            string package = Path.Combine(Environment.GetEnvironmentVariable("IRIS_REPO"), "unity_client");
            Project.Reset(folder, package);
            Project.Packages["com.iris-session.unity"] = "0.1.0";
            string list = File.ReadAllText(Path.Combine(package, "Documentation~/quest-3.manifest.json"));
            foreach (Match one in Regex.Matches(list, "\"(com\\.[a-z0-9.-]+)\": \"([0-9.]+)\"")) Project.Packages[one.Groups[1].Value] = one.Groups[2].Value;
            foreach (string module in new[] { "androidjni", "imageconversion" }) Project.Packages.Remove("com.unity.modules." + module); // what is part of the editor is not found as a package
            foreach (string name in new[] { "IrisSurface", "IrisPoints", "IrisRay" })
                Project.Assets["Packages/com.iris-session.unity/Runtime/Unity/Materials/" + name + ".mat"] = new Material(new Shader(name));
            FeatureHelpers.Ids[BuildTargetGroup.Android] = new[]
            {
                "com.unity.openxr.feature.arfoundation-meta-session", "com.unity.openxr.feature.arfoundation-meta-camera", "com.unity.openxr.feature.arfoundation-meta-anchor",
                "com.unity.openxr.feature.compositionlayers", "com.unity.openxr.feature.arfoundation-spatialentities-setup", "com.unity.openxr.feature.arfoundation-spatialentities-marker",
                "com.unity.openxr.feature.input.oculustouch", "com.unity.openxr.feature.input.metaquestplus", "com.unity.openxr.feature.input.metahandtrackingaim",
            };
            FeatureHelpers.Ids[BuildTargetGroup.WSA] = new[] { "com.microsoft.openxr.feature.hololens", "com.microsoft.openxr.feature.handtracking", "com.unity.openxr.feature.input.eyetracking" };
        }

        [TearDown]
        public void End()
        {
            Directory.Delete(folder, true);
            Engine.Reset();
        }

        [Test]
        public void AProjectForQuestHasItsSettings()
        {
            QuestSetup.SetUp();
            CheckNothingIsLeft();
            Assert.AreEqual(ScriptingImplementation.IL2CPP, PlayerSettings.GetScriptingBackend(NamedBuildTarget.Android));
            Assert.AreEqual(AndroidArchitecture.ARM64, PlayerSettings.Android.targetArchitectures);
            Assert.AreEqual(AndroidSdkVersions.AndroidApiLevel32, PlayerSettings.Android.minSdkVersion);
            Assert.AreEqual(AndroidApplicationEntry.GameActivity, PlayerSettings.Android.applicationEntry);
            Assert.AreEqual(ColorSpace.Linear, PlayerSettings.colorSpace);
            Assert.IsFalse(PlayerSettings.GetUseDefaultGraphicsAPIs(BuildTarget.Android));
            Assert.AreEqual(new[] { GraphicsDeviceType.Vulkan }, PlayerSettings.GetGraphicsAPIs(BuildTarget.Android));
            Assert.IsTrue(PlayerSettings.Android.forceInternetPermission);
            Assert.AreEqual(ManagedStrippingLevel.Minimal, PlayerSettings.GetManagedStrippingLevel(NamedBuildTarget.Android), "less than High stays");
            Assert.AreEqual(BuildTarget.Android, EditorUserBuildSettings.activeBuildTarget);
            Assert.IsTrue(UnityEditor.XR.Management.Metadata.XRPackageMetadataStore.IsLoaderAssigned(Loader, BuildTargetGroup.Android));
            OpenXRFeature[] features = OpenXRSettings.GetSettingsForBuildTargetGroup(BuildTargetGroup.Android).GetFeatures();
            Assert.AreEqual(new[] { "MicrosoftHandInteraction", "com.unity.openxr.feature.arfoundation-meta-anchor" }, features.Where(one => !one.enabled).Select(one => one.Id.EndsWith("handtracking") ? one.GetType().Name : one.Id).ToArray());
            Assert.AreEqual(new[] { "Quest 3", "Quest 3S" }, features.OfType<MetaQuestFeature>().Single().targetDevices.Where(one => one.enabled).Select(one => one.visibleName).ToArray());

            CheckSecondRunChangesNothing(QuestSetup.SetUp);
        }

        [Test]
        public void WhatIsMissingOrOlderIsInstalledFirst()
        {
            Project.Packages.Remove("com.unity.xr.hands");
            Project.Packages["com.unity.xr.openxr"] = "1.16.1";
            Project.Packages["com.unity.inputsystem"] = "1.19.0"; // newer is good
            QuestSetup.SetUp();
            Assert.AreEqual(new[] { "com.unity.xr.hands@1.7.3", "com.unity.xr.openxr@1.17.1" }, Project.Requests.ToArray());
            Assert.AreEqual(BuildTarget.StandaloneWindows64, EditorUserBuildSettings.activeBuildTarget, "the rest comes after that");
            Assert.IsFalse(File.Exists(Path.Combine(folder, AndroidManifest.File)));
        }

        [Test]
        public void PackagesThatCannotBeInstalledAreSaid()
        {
            Project.Packages.Remove("com.unity.xr.hands");
            QuestSetup.SetUp();
            QuestSetup.SetUp(); // an impatient person
            EditorApplication.update();
            Assert.IsFalse(Engine.Log.Any(line => line.StartsWith("error")), "it may take minutes");
            Project.Request.Error = new UnityEditor.PackageManager.Error("Cannot find com.unity.xr.hands@1.7.3");
            Project.Request.IsCompleted = true;
            EditorApplication.update();
            Assert.IsNull(EditorApplication.update, "it is said once");
            StringAssert.Contains("Cannot find com.unity.xr.hands@1.7.3", Engine.Log.Single(line => line.StartsWith("error")));
        }

        [Test]
        public void AnIdThatIsTheTemplatesIsLeftToAPerson()
        {
            PlayerSettings.Identifier = "com.UnityTechnologies.com.unity.template.urpblank";
            QuestSetup.SetUp();
            Assert.AreEqual(1, CountWarnings());
            Assert.IsTrue(Engine.Log.Any(line => line.Contains("Override Default Package Name") && line.Contains(PlayerSettings.Identifier)));
            Assert.AreEqual(BuildTarget.Android, EditorUserBuildSettings.activeBuildTarget, "the other steps are done");
        }

        [Test]
        public void StepsThatCannotBeDoneAreSaid()
        {
            BuildPipeline.Modules.Remove(BuildTarget.Android);
            QuestSetup.SetUp();
            Assert.AreEqual(1, CountWarnings());
            Assert.AreEqual(ColorSpace.Gamma, PlayerSettings.colorSpace);

            BuildPipeline.Modules.Add(BuildTarget.Android);
            FeatureHelpers.Ids[BuildTargetGroup.Android] = FeatureHelpers.Ids[BuildTargetGroup.Android].Where(id => !id.Contains("spatialentities-marker")).ToArray();
            GraphicsSettings.Pipeline = null;
            Engine.Log.Clear();
            QuestSetup.SetUp();
            Assert.AreEqual(2, CountWarnings());
            Assert.IsTrue(Engine.Log.Any(line => line.Contains("spatialentities-marker")));
            Assert.AreEqual(BuildTarget.Android, EditorUserBuildSettings.activeBuildTarget, "the other steps are done");
        }

        [Test]
        public void StrippingThatIsTooHighIsLowered()
        {
            PlayerSettings.SetManagedStrippingLevel(NamedBuildTarget.Android, ManagedStrippingLevel.High);
            QuestSetup.SetUp();
            Assert.AreEqual(ManagedStrippingLevel.Medium, PlayerSettings.GetManagedStrippingLevel(NamedBuildTarget.Android));
        }

        [Test]
        public void TheManifestOfANewProjectHasWhatTheAppNeeds()
        {
            QuestSetup.SetUp();
            XmlDocument manifest = new XmlDocument();
            manifest.Load(Path.Combine(folder, AndroidManifest.File));
            string[] permissions =
            {
                "android.permission.ACCESS_WIFI_STATE", "android.permission.CHANGE_WIFI_MULTICAST_STATE", "android.permission.INTERNET",
                "com.oculus.permission.HAND_TRACKING", "com.oculus.permission.USE_SCENE",
            };
            Assert.AreEqual(permissions, Read(manifest, "/manifest/uses-permission[count(@*) = 1]", "name"));
            string[] refused = { "android.permission.CAMERA", "com.oculus.permission.USE_PASSTHROUGH_CAMERA", "horizonos.permission.HEADSET_CAMERA" };
            Assert.AreEqual(refused, Read(manifest, "/manifest/uses-permission[@*[name() = 'tools:node'] = 'remove']", "name"));
            Assert.AreEqual(new[] { "oculus.software.handtracking", "oculus.software.overlay_keyboard" }, Read(manifest, "/manifest/uses-feature", "name"));
            Assert.AreEqual(new[] { "false", "false" }, Read(manifest, "/manifest/uses-feature", "required"));
            const string Activity = "/manifest/application/activity";
            Assert.AreEqual(new[] { AndroidManifest.Activity }, Read(manifest, Activity, "name"));
            Assert.AreEqual(new[] { "android.app.lib_name", "com.oculus.vr.focusaware", "unityplayer.UnityActivity" }, Read(manifest, Activity + "/meta-data", "name"));
            Assert.AreEqual(new[] { "android.intent.category.LAUNCHER" }, Read(manifest, Activity + "/intent-filter/category", "name"));
            Assert.AreEqual(0, manifest.SelectNodes("/manifest/application/meta-data").Count, "supported devices are written by the OpenXR plug-in");
        }

        private static string[] Read(XmlDocument document, string path, string attribute)
        {
            return document.SelectNodes(path).Cast<XmlElement>().Select(one => one.GetAttribute(attribute, "http://schemas.android.com/apk/res/android")).OrderBy(one => one, StringComparer.Ordinal).ToArray();
        }

        [Test]
        public void AManifestThatIsThereIsCompleted()
        {
            string path = Path.Combine(folder, AndroidManifest.File);
            Directory.CreateDirectory(Path.GetDirectoryName(path));
            const string Own = "<manifest xmlns:android=\"http://schemas.android.com/apk/res/android\">\r\n  <!-- ours -->\r\n  <uses-permission android:name=\"android.permission.INTERNET\" />\r\n  <uses-permission android:name=\"android.permission.CAMERA\" />\r\n  <application>\r\n    <activity android:name=\"com.unity3d.player.UnityPlayerGameActivity\" />\r\n"
                + "    <meta-data android:name=\"com.oculus.supportedDevices\" android:value=\"quest3\" />\r\n  </application>\r\n</manifest>";
            File.WriteAllText(path, Own);
            QuestSetup.SetUp();
            string text = File.ReadAllText(path);
            StringAssert.Contains("<!-- ours -->", text);
            Assert.AreEqual(1, Regex.Matches(text, "android.permission.INTERNET").Count);
            StringAssert.Contains("com.oculus.permission.USE_SCENE", text);
            Assert.AreEqual(2, Regex.Matches(text, "tools:node=\"remove\"").Count, "the project has pictures of its own to take");
            Assert.AreEqual(1, CountWarnings(), "two values of supported devices end a build");

            File.WriteAllText(path, "<manifest");
            Engine.Log.Clear();
            QuestSetup.SetUp();
            Assert.AreEqual("<manifest", File.ReadAllText(path));
            Assert.AreEqual(1, CountWarnings());
        }

        [Test]
        public void AProjectForHoloLensHasItsSettings()
        {
            HoloLensSetup.SetUp();
            CheckNothingIsLeft();
            Assert.AreEqual(ScriptingImplementation.IL2CPP, PlayerSettings.GetScriptingBackend(NamedBuildTarget.WindowsStoreApps));
            Assert.AreEqual(new[] { GraphicsDeviceType.Direct3D11 }, PlayerSettings.GetGraphicsAPIs(BuildTarget.WSAPlayer));
            Assert.AreEqual("ARM64", EditorUserBuildSettings.wsaArchitecture);
            Assert.AreEqual(BuildTarget.WSAPlayer, EditorUserBuildSettings.activeBuildTarget);
            string[] capabilities = { "GazeInput", "InternetClient", "InternetClientServer", "PrivateNetworkClientServer", "SpatialPerception", "WebCam" };
            Assert.AreEqual(capabilities, PlayerSettings.WSA.Capabilities.Select(one => one.ToString()).OrderBy(one => one, StringComparer.Ordinal).ToArray());
            OpenXRFeature[] features = OpenXRSettings.GetSettingsForBuildTargetGroup(BuildTargetGroup.WSA).GetFeatures();
            Assert.AreEqual(new[] { "HandTracking", "MetaQuestFeature" }, features.Where(one => !one.enabled).Select(one => one.GetType().Name).ToArray());

            CheckSecondRunChangesNothing(HoloLensSetup.SetUp);
        }

        [Test]
        public void TheSceneOfQuestIsWhole()
        {
            QuestSceneCommand.Create();
            CheckNothingIsLeft();
            GameObject offset = CheckRig();
            IrisQuest quest = offset.GetComponent<IrisQuest>();
            XROrigin origin = Find("XR Origin").GetComponent<XROrigin>();
            ARMarkerManager codes = origin.GetComponent<ARMarkerManager>();
            Assert.AreSame(origin, GetField(quest, "origin"));
            Assert.AreSame(codes, GetField(quest, "markerManager"));
            Assert.AreSame(origin.Camera.GetComponent<ARCameraManager>(), GetField(quest, "cameraManager"));
            Assert.IsFalse(codes.enabled, "before the wearer has allowed it");
            Assert.IsTrue(Project.Undos.Contains("XR Origin.ARMarkerManager"));

            CheckSecondRunChangesNothing(QuestSceneCommand.Create);
        }

        [Test]
        public void TheSceneOfHoloLensIsWhole()
        {
            HoloLensScene.Create();
            CheckNothingIsLeft();
            GameObject offset = CheckRig();
            IrisHoloLens hololens = offset.GetComponent<IrisHoloLens>();
            MicrosoftMarkerManager codes = Find("XR Origin").GetComponent<MicrosoftMarkerManager>();
            Assert.AreSame(Find("XR Origin").GetComponent<XROrigin>(), GetField(hololens, "origin"));
            Assert.AreSame(codes, GetField(hololens, "markerManager"));
            Assert.AreEqual(1, codes.enabledMarkerTypes.Length);
            Assert.IsFalse(codes.enabled);

            CheckSecondRunChangesNothing(HoloLensScene.Create);
        }

        [Test]
        public void ASceneThatIsThereKeepsWhatTheUserHasChanged()
        {
            HoloLensScene.Create();
            GameObject head = Find("XR Origin").transform.GetChild(0).GetChild(0).gameObject;
            head.GetComponent<Camera>().farClipPlane = 30f;
            new GameObject("Table").transform.SetParent(Find("XR Origin").transform);
            head.GetComponent<TrackedPoseDriver>().Release(); // without a frame: none runs in the editor
            HoloLensScene.Create();
            Assert.IsNotNull(head.GetComponent<TrackedPoseDriver>(), "what is missing is added");
            Assert.AreEqual(30f, head.GetComponent<Camera>().farClipPlane);
            Assert.AreEqual("Main Camera.TrackedPoseDriver", Project.Undos.Last());
        }

        [Test]
        public void AnOpenSceneThatTheUserKeepsIsLeftAlone()
        {
            new GameObject("Mine");
            Project.MaySaveOpenScene = false;
            HoloLensScene.Create();
            Assert.AreEqual("Mine", Engine.FindRoots().Single().name);
            Assert.AreEqual(0, EditorBuildSettings.scenes.Length);
        }

        [Test]
        public void OtherScenesOfTheBuildStay()
        {
            EditorBuildSettings.scenes = new[] { new EditorBuildSettingsScene("Assets/Scenes/SampleScene.unity", true) };
            HoloLensScene.Create();
            Assert.AreEqual(new[] { SceneAssets.ScenePath, "Assets/Scenes/SampleScene.unity" }, EditorBuildSettings.scenes.Select(one => one.path).ToArray());
        }

        /// <summary>Check what all headsets share; return the camera offset.</summary>
        private static GameObject CheckRig()
        {
            XROrigin origin = Find("XR Origin").GetComponent<XROrigin>();
            Assert.IsNotNull(Find("AR Session").GetComponent<ARSession>());
            GameObject offset = origin.CameraFloorOffsetObject;
            Assert.AreSame(origin.transform, offset.transform.parent);
            Assert.AreSame(offset.transform, origin.Camera.transform.parent);
            Assert.AreEqual(XROrigin.TrackingOriginMode.Floor, origin.RequestedTrackingOriginMode);
            Assert.AreEqual(0f, origin.Camera.backgroundColor.a);
            Assert.AreEqual(CameraClearFlags.SolidColor, origin.Camera.clearFlags);
            Assert.AreEqual("<XRHMD>/centerEyePosition", origin.Camera.GetComponent<TrackedPoseDriver>().positionInput.action.Path);
            Assert.IsNotNull(offset.GetComponent<IrisApp>());
            Assert.IsTrue(offset.GetComponent<IrisWorld>().Materials.AreSet);
            Assert.IsNotNull(GetField(offset.GetComponent<IrisHeadset>(), "rayMaterial"));
            Assert.AreEqual(SceneAssets.ScenePath, EditorBuildSettings.scenes.Single().path);
            Assert.IsTrue(Project.Assets.ContainsKey(SceneAssets.ScenePath));
            return offset;
        }

        private static GameObject Find(string root) { return Engine.FindRoots().Single(one => one.name == root); }

        private static object GetField(object owner, string name)
        {
            return owner.GetType().GetField(name, System.Reflection.BindingFlags.Instance | System.Reflection.BindingFlags.NonPublic).GetValue(owner);
        }

        private static int CountWarnings() { return Engine.Log.Count(line => line.StartsWith("warning")); }

        private static void CheckNothingIsLeft()
        {
            Assert.AreEqual("", string.Join("\n", Engine.Log.Where(line => line.StartsWith("warning"))));
            Assert.AreEqual(0, Engine.Errors.Count, string.Join("\n", Engine.Errors));
        }

        private void CheckSecondRunChangesNothing(Action command)
        {
            string[] files = Directory.GetFiles(folder, "*", SearchOption.AllDirectories);
            string[] texts = files.Select(File.ReadAllText).ToArray();
            int undos = Project.Undos.Count;
            Engine.Log.Clear();
            command();
            CheckNothingIsLeft();
            Assert.IsTrue(Engine.Log.Last().EndsWith("nothing to change"), string.Join("\n", Engine.Log));
            Assert.AreEqual(texts, Directory.GetFiles(folder, "*", SearchOption.AllDirectories).Select(File.ReadAllText).ToArray());
            Assert.AreEqual(undos, Project.Undos.Count);
        }
    }
}
