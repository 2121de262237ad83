// Folders and scenes of a project, as assets.
using System.Collections.Generic;
using UnityEditor;
using UnityEditor.SceneManagement;
using UnityEngine.SceneManagement;

namespace IrisSession.Editor
{
    public static class SceneAssets
    {
        public const string Folder = "Assets/IrisSession";
        public const string ScenePath = Folder + "/Robot Scene.unity";

        /// <summary>Open the scene of the app, or begin it. False: the user kept what is open.</summary>
        public static bool TryOpen(out Scene scene)
        {
            scene = default;
            if (!EditorSceneManager.SaveCurrentModifiedScenesIfUserWantsTo()) return false;
            bool isThere = AssetDatabase.LoadMainAssetAtPath(ScenePath) != null;
            scene = isThere ? EditorSceneManager.OpenScene(ScenePath) : EditorSceneManager.NewScene(NewSceneSetup.EmptyScene, NewSceneMode.Single);
            return true;
        }

        /// <summary>Save the scene and make it the first of the build.</summary>
        public static void Save(Scene scene, SetupReport report)
        {
            if (report.Changes.Count > 0)
            {
                MakeFolder(Folder);
                EditorSceneManager.MarkSceneDirty(scene);
                if (EditorSceneManager.SaveScene(scene, ScenePath)) report.Change("scene saved: " + ScenePath);
                else report.Leave("the scene could not be saved: File > Save As, " + ScenePath);
            }
            List<EditorBuildSettingsScene> scenes = new List<EditorBuildSettingsScene>(EditorBuildSettings.scenes);
            if (scenes.Count > 0 && scenes[0].path == ScenePath && scenes[0].enabled) return;
            scenes.RemoveAll(one => one.path == ScenePath);
            scenes.Insert(0, new EditorBuildSettingsScene(ScenePath, true));
            EditorBuildSettings.scenes = scenes.ToArray();
            report.Change("first scene of the build: " + ScenePath);
        }

        /// <summary>Make a folder below Assets.</summary>
        public static void MakeFolder(string path)
        {
            if (AssetDatabase.IsValidFolder(path)) return;
            int end = path.LastIndexOf('/');
            MakeFolder(path.Substring(0, end));
            AssetDatabase.CreateFolder(path.Substring(0, end), path.Substring(end + 1));
        }
    }
}
