// Poses between the engine and the core. Axes are changed by UnityAxes alone: nothing here knows them.
using IrisSession.Core;
using UnityEngine;

namespace IrisSession.Unity.Input
{
    /// <summary>Conversions without choices.</summary>
    public static class EnginePoses
    {
        /// <summary>Return a pose of the engine in the axes of the wire.</summary>
        public static RigidTransform ToWire(Vector3 position, Quaternion rotation)
        {
            return UnityAxes.FromUnity(ToUnityPose(position, rotation));
        }

        public static UnityPose ToUnityPose(Vector3 position, Quaternion rotation)
        {
            return new UnityPose(new Float3(position.x, position.y, position.z), new FloatQuaternion(rotation.x, rotation.y, rotation.z, rotation.w));
        }

        /// <summary>Return a point of the wire in the engine.</summary>
        public static Vector3 ToEngine(Double3 point)
        {
            Float3 value = UnityAxes.ToUnity(point);
            return new Vector3(value.X, value.Y, value.Z);
        }

        /// <summary>Return a rotation of the wire in the engine.</summary>
        public static Quaternion ToEngine(DoubleQuaternion rotation)
        {
            FloatQuaternion value = UnityAxes.ToUnity(rotation);
            return new Quaternion(value.X, value.Y, value.Z, value.W);
        }
    }
}
