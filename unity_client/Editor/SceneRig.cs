// What the scenes of all headsets have: the origin, the tracked camera, and the components of a session on the camera offset.
using IrisSession.Unity;
using IrisSession.Unity.Input;
using Unity.XR.CoreUtils;
using UnityEditor;
using UnityEngine;
using UnityEngine.InputSystem;
using UnityEngine.InputSystem.XR;
using UnityEngine.SceneManagement;

namespace IrisSession.Editor
{
    /// <summary>Finds the objects by their names, and adds what is missing: what a user has changed stays.</summary>
    public sealed class SceneRig
    {
        private const string Materials = "Packages/com.iris-session.unity/Runtime/Unity/Materials/";

        private readonly Scene scene;
        private readonly SetupReport report;

        public SceneRig(Scene scene, SetupReport report)
        {
            this.scene = scene;
            this.report = report;
            GameObject origin = FindRoot("XR Origin");
            Offset = FindChild(origin, "Camera Offset");
            GameObject head = FindChild(Offset, "Main Camera");
            Origin = Need<XROrigin>(origin);
            Camera = Need<Camera>(head);
            if (Origin.Camera == null)
            {
                Origin.Origin = origin;
                Origin.CameraFloorOffsetObject = Offset;
                Origin.Camera = Camera;
                Origin.RequestedTrackingOriginMode = XROrigin.TrackingOriginMode.Floor;
                Camera.gameObject.tag = "MainCamera";
                Camera.clearFlags = CameraClearFlags.SolidColor; // with alpha 0 the room is seen behind it
                Camera.backgroundColor = new Color(0f, 0f, 0f, 0f);
                Camera.allowHDR = false; // else alpha is lost
                Camera.nearClipPlane = 0.05f;
                Camera.farClipPlane = 100f;
            }
            TrackHead(head);
            SetMaterials(Need<IrisWorld>(Offset));
            SetRays(Need<IrisHeadset>(Offset));
        }

        public XROrigin Origin { get; private set; }

        /// <summary>The object in whose frame the headset tracks.</summary>
        public GameObject Offset { get; private set; }

        public Camera Camera { get; private set; }

        /// <summary>The component of an object; made where it is missing.</summary>
        public T Need<T>(GameObject one) where T : Component
        {
            T found = one.GetComponent<T>();
            if (found != null) return found;
            report.Change(one.name + ": " + typeof(T).Name);
            return Undo.AddComponent<T>(one);
        }

        /// <summary>An object at the top of the scene; made where it is missing.</summary>
        public GameObject FindRoot(string name)
        {
            foreach (GameObject one in scene.GetRootGameObjects()) if (one.name == name) return one;
            return Make(name);
        }

        private GameObject FindChild(GameObject parent, string name)
        {
            for (int i = 0; i < parent.transform.childCount; i++)
            {
                GameObject one = parent.transform.GetChild(i).gameObject;
                if (one.name == name) return one;
            }
            GameObject made = Make(name);
            made.transform.SetParent(parent.transform, false);
            return made;
        }

        private GameObject Make(string name)
        {
            GameObject made = new GameObject(name);
            Undo.RegisterCreatedObjectUndo(made, "Create " + name);
            report.Change("object: " + name);
            return made;
        }

        private void TrackHead(GameObject head)
        {
            if (head.GetComponent<TrackedPoseDriver>() != null) return;
            TrackedPoseDriver driver = Need<TrackedPoseDriver>(head);
            driver.positionInput = new InputActionProperty(new InputAction("Head position", InputActionType.Value, "<XRHMD>/centerEyePosition", expectedControlType: "Vector3"));
            driver.rotationInput = new InputActionProperty(new InputAction("Head rotation", InputActionType.Value, "<XRHMD>/centerEyeRotation", expectedControlType: "Quaternion"));
            driver.trackingStateInput = new InputActionProperty(new InputAction("Head tracking", InputActionType.Value, "<XRHMD>/trackingState", expectedControlType: "Integer"));
        }

        private void SetMaterials(IrisWorld world)
        {
            if (world.Materials.AreSet) return;
            if (world.Materials.Surface == null) world.Materials.Surface = Load("IrisSurface.mat");
            if (world.Materials.Points == null) world.Materials.Points = Load("IrisPoints.mat");
            EditorUtility.SetDirty(world);
            if (world.Materials.AreSet) report.Change("IrisWorld: materials of the package");
        }

        private void SetRays(IrisHeadset headset)
        {
            SerializedObject fields = new SerializedObject(headset);
            SerializedProperty material = fields.FindProperty("rayMaterial");
            if (material.objectReferenceValue != null) return;
            material.objectReferenceValue = Load("IrisRay.mat");
            if (fields.ApplyModifiedProperties()) report.Change("IrisHeadset: material of rays");
        }

        private Material Load(string name)
        {
            Material found = AssetDatabase.LoadAssetAtPath<Material>(Materials + name);
            if (found == null) report.Leave("'" + Offset.name + "' needs " + Materials + name + ", which was not found");
            return found;
        }
    }
}
