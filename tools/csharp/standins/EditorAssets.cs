// The editor: a project as the assets and settings that commands write. No frames run meanwhile.
using System;
using System.Collections;
using System.Collections.Generic;
using System.Reflection;
using UnityEngine;

namespace Standins
{
    /// <summary>The open project. Begins as a new one of Unity 6 with URP, the packages of the app installed, the platform Windows.</summary>
    public static class Project
    {
        public static readonly Dictionary<string, UnityEngine.Object> Assets = new Dictionary<string, UnityEngine.Object>();
        public static readonly Dictionary<string, string> Packages = new Dictionary<string, string>();

        /// <summary>Identifiers that were asked of the package manager.</summary>
        public static readonly List<string> Requests = new List<string>();

        /// <summary>The newest of the requests: tests complete it.</summary>
        internal static UnityEditor.PackageManager.Requests.AddAndRemoveRequest Request;

        /// <summary>Names of objects and components that can be undone.</summary>
        public static readonly List<string> Undos = new List<string>();
        public static readonly HashSet<string> Folders = new HashSet<string>();
        public static string PackageFolder = "";

        /// <summary>What the user answers when the open scene would be lost.</summary>
        public static bool MaySaveOpenScene = true;

        /// <summary>Begin with a new project whose Assets are in a folder of the disk.</summary>
        public static void Reset(string dataPath, string packageFolder)
        {
            Engine.Reset();
            Engine.IsEditing = true;
            Assets.Clear();
            Packages.Clear();
            Requests.Clear();
            Undos.Clear();
            Folders.Clear();
            Folders.Add("Assets");
            MaySaveOpenScene = true;
            Application.DataPath = dataPath;
            PackageFolder = packageFolder;
            UnityEditor.EditorBuildSettings.scenes = new UnityEditor.EditorBuildSettingsScene[0];
            UnityEditor.EditorBuildSettings.Objects.Clear();
            UnityEditor.SceneManagement.EditorSceneManager.OpenPath = "";
            UnityEditor.PlayerSettings.Reset();
            UnityEditor.EditorApplication.update = null;
            UnityEngine.XR.OpenXR.OpenXRSettings.All.Clear();
            UnityEngine.Rendering.GraphicsSettings.Pipeline = new UniversalPipeline();
        }

        private sealed class UniversalPipeline : UnityEngine.Rendering.RenderPipelineAsset
        {
        }
    }
}

namespace UnityEditor
{
    [AttributeUsage(AttributeTargets.Method, AllowMultiple = true)]
    public sealed class MenuItem : Attribute
    {
        public string menuItem;

        public MenuItem(string itemName, bool isValidateFunction, int priority)
        {
            menuItem = itemName;
        }
    }

    public sealed class AssetDatabase
    {
        public static string CreateFolder(string parentFolder, string newFolderName)
        {
            if (!IsValidFolder(parentFolder)) throw new InvalidOperationException("there is no folder " + parentFolder);
            Standins.Project.Folders.Add(parentFolder + "/" + newFolderName);
            return newFolderName;
        }

        public static bool IsValidFolder(string path) { return Standins.Project.Folders.Contains(path); }

        public static void CreateAsset(UnityEngine.Object asset, string path)
        {
            if (!IsValidFolder(path.Substring(0, path.LastIndexOf('/')))) throw new InvalidOperationException("there is no folder for " + path);
            Standins.Project.Assets.Add(path, asset);
        }

        public static void ImportAsset(string path) { }

        public static UnityEngine.Object LoadMainAssetAtPath(string assetPath) { return Standins.Project.Assets.TryGetValue(assetPath, out UnityEngine.Object found) ? found : null; }

        public static T LoadAssetAtPath<T>(string assetPath) where T : UnityEngine.Object { return LoadMainAssetAtPath(assetPath) as T; }

        public static void SaveAssets() { }
    }

    public sealed class EditorApplication
    {
        public delegate void CallbackFunction();

        public static CallbackFunction update;
    }

    public class EditorUtility
    {
        public static void SetDirty(UnityEngine.Object target) { }
    }

    public class Undo
    {
        public static void RegisterCreatedObjectUndo(UnityEngine.Object objectToUndo, string name) { Standins.Project.Undos.Add(objectToUndo.name); }

        public static T AddComponent<T>(GameObject gameObject) where T : Component
        {
            Standins.Project.Undos.Add(gameObject.name + "." + typeof(T).Name);
            return gameObject.AddComponent<T>();
        }
    }

    public class EditorBuildSettings : UnityEngine.Object
    {
        internal static readonly Dictionary<string, UnityEngine.Object> Objects = new Dictionary<string, UnityEngine.Object>();

        public static EditorBuildSettingsScene[] scenes { get; set; } = new EditorBuildSettingsScene[0];

        public static void AddConfigObject(string name, UnityEngine.Object obj, bool overwrite) { Objects[name] = obj; }

        public static bool TryGetConfigObject<T>(string name, out T result) where T : UnityEngine.Object
        {
            result = Objects.TryGetValue(name, out UnityEngine.Object found) ? found as T : null;
            return result != null;
        }
    }

    public class EditorBuildSettingsScene
    {
        public EditorBuildSettingsScene(string path, bool enabled)
        {
            this.path = path;
            this.enabled = enabled;
        }

        public bool enabled { get; set; }

        public string path { get; set; }
    }

    /// <summary>Serialised fields of an object, by their names. Changes come to it with ApplyModifiedProperties.</summary>
    public class SerializedObject : IDisposable
    {
        internal readonly List<Action> Changes = new List<Action>();
        private readonly UnityEngine.Object target;

        public SerializedObject(UnityEngine.Object obj)
        {
            target = obj;
        }

        public SerializedProperty FindProperty(string propertyPath) { return SerializedProperty.Find(this, target, propertyPath, _ => { }); }

        public bool ApplyModifiedProperties()
        {
            bool hasChanged = Changes.Count > 0;
            foreach (Action one in Changes) one();
            Changes.Clear();
            return hasChanged;
        }

        public void Dispose() { }
    }

    public class SerializedProperty : IDisposable
    {
        private readonly SerializedObject root;
        private readonly Action<object> set;
        private object value;

        internal SerializedProperty(SerializedObject root, object value, Action<object> set)
        {
            this.root = root;
            this.value = value;
            this.set = set;
        }

        public int arraySize { get { return ((IList)value).Count; } }

        public bool boolValue { get { return (bool)value; } set { Set(value); } }

        public string stringValue { get { return (string)value; } set { Set(value); } }

        public UnityEngine.Object objectReferenceValue { get { return (UnityEngine.Object)value; } set { Set(value); } }

        public SerializedProperty GetArrayElementAtIndex(int index)
        {
            IList list = (IList)value;
            return new SerializedProperty(root, list[index], changed => list[index] = changed);
        }

        public SerializedProperty FindPropertyRelative(string relativePropertyPath) { return Find(root, value, relativePropertyPath, set); }

        public void Dispose() { }

        internal static SerializedProperty Find(SerializedObject root, object owner, string name, Action<object> setOwner)
        {
            FieldInfo field = owner.GetType().GetField(name, BindingFlags.Instance | BindingFlags.Public | BindingFlags.NonPublic);
            if (field == null) return null;
            return new SerializedProperty(root, field.GetValue(owner), changed =>
            {
                field.SetValue(owner, changed);
                setOwner(owner); // a struct is a copy
            });
        }

        private void Set(object changed)
        {
            value = changed;
            root.Changes.Add(() => set(changed));
        }
    }
}

namespace UnityEditor.PackageManager
{
    public sealed class PackageInfo
    {
        internal PackageInfo()
        {
        }

        public string version { get; internal set; }

        public string resolvedPath { get; internal set; }

        public static PackageInfo FindForAssetPath(string assetPath)
        {
            string name = assetPath.Split('/')[1];
            return Standins.Project.Packages.TryGetValue(name, out string version) ? new PackageInfo { version = version, resolvedPath = Standins.Project.PackageFolder } : null;
        }
    }

    public class PackageCollection
    {
        internal PackageCollection()
        {
        }
    }

    public class Error
    {
        internal Error(string message)
        {
            this.message = message;
        }

        public string message { get; }
    }

    public static class Client
    {
        public static Requests.AddAndRemoveRequest AddAndRemove(string[] packagesToAdd = null, string[] packagesToRemove = null)
        {
            Standins.Project.Requests.AddRange(packagesToAdd);
            return Standins.Project.Request = new Requests.AddAndRemoveRequest();
        }
    }
}

namespace UnityEditor.PackageManager.Requests
{
    public abstract class Request
    {
        internal Request()
        {
        }

        public bool IsCompleted { get; internal set; }

        public Error Error { get; internal set; }
    }

    public abstract class Request<T> : Request
    {
        internal Request()
        {
        }
    }

    public sealed class AddAndRemoveRequest : Request<PackageCollection>
    {
        internal AddAndRemoveRequest()
        {
        }
    }
}

namespace UnityEngine.SceneManagement
{
    public struct Scene
    {
        /// <summary>There is one open scene: all objects without a parent are in it.</summary>
        public GameObject[] GetRootGameObjects() { return Standins.Engine.FindRoots(); }
    }

    public class SceneManager
    {
    }
}

namespace UnityEditor.SceneManagement
{
    public enum NewSceneSetup
    {
        EmptyScene = 0,
        DefaultGameObjects = 1,
    }

    public enum NewSceneMode
    {
        Single = 0,
        Additive = 1,
    }

    public sealed class EditorSceneManager : UnityEngine.SceneManagement.SceneManager
    {
        internal static string OpenPath = "";

        public static bool SaveCurrentModifiedScenesIfUserWantsTo() { return Standins.Project.MaySaveOpenScene; }

        public static UnityEngine.SceneManagement.Scene NewScene(NewSceneSetup setup, NewSceneMode mode)
        {
            foreach (GameObject one in Standins.Engine.FindRoots()) one.Release();
            OpenPath = "";
            return default;
        }

        public static UnityEngine.SceneManagement.Scene OpenScene(string scenePath)
        {
            if (scenePath != OpenPath) throw new InvalidOperationException("only the scene that was saved last can be opened: " + OpenPath);
            return default;
        }

        public static bool MarkSceneDirty(UnityEngine.SceneManagement.Scene scene) { return true; }

        public static bool SaveScene(UnityEngine.SceneManagement.Scene scene, string dstScenePath)
        {
            if (!AssetDatabase.IsValidFolder(dstScenePath.Substring(0, dstScenePath.LastIndexOf('/')))) return false;
            Standins.Project.Assets[dstScenePath] = new SceneAsset();
            OpenPath = dstScenePath;
            return true;
        }

        private sealed class SceneAsset : UnityEngine.Object
        {
        }
    }
}
