// Types of the engine that have the names of types of ours and are not used: a source that leaves open which one it means must not
// compile here either. The others of this kind (Camera, ColorSpace, Light, Material, Mesh, Pose, Texture) have behaviour.
namespace UnityEngine
{
    public class Avatar : Object
    {
        internal Avatar()
        {
        }
    }

    public sealed class Event
    {
    }
}
