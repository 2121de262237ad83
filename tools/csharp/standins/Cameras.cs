// Cameras and scriptable objects, as far as scenes and settings have them.
namespace UnityEngine
{
    public enum CameraClearFlags
    {
        Skybox = 1,
        SolidColor = 2,
    }

    public enum ColorSpace
    {
        Gamma = 0,
        Linear = 1,
    }

    public sealed class Camera : Behaviour
    {
        public float nearClipPlane { get; set; } = 0.3f;

        public float farClipPlane { get; set; } = 1000f;

        public bool allowHDR { get; set; } = true;

        public Color backgroundColor { get; set; }

        public CameraClearFlags clearFlags { get; set; } = CameraClearFlags.Skybox;
    }

    public class ScriptableObject : Object
    {
        public static T CreateInstance<T>() where T : ScriptableObject { return (T)System.Activator.CreateInstance(typeof(T), true); }
    }
}

namespace UnityEngine.Rendering
{
    public abstract class RenderPipelineAsset : ScriptableObject
    {
    }

    public enum GraphicsDeviceType
    {
        Direct3D11 = 2,
        OpenGLES3 = 11,
        Direct3D12 = 18,
        Vulkan = 21,
    }

    public sealed class GraphicsSettings : Object
    {
        internal static RenderPipelineAsset Pipeline;

        public static RenderPipelineAsset currentRenderPipeline { get { return Pipeline; } }
    }
}

namespace UnityEngine.InputSystem
{
    public struct InputActionProperty
    {
        public InputActionProperty(InputAction action)
        {
            this.action = action;
        }

        public InputAction action { get; }
    }
}

namespace UnityEngine.InputSystem.XR
{
    public class TrackedPoseDriver : MonoBehaviour
    {
        public InputActionProperty positionInput { get; set; }

        public InputActionProperty rotationInput { get; set; }

        public InputActionProperty trackingStateInput { get; set; }
    }
}
