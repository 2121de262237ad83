// Values of the core as those of the engine. Axes are changed by UnityAxes alone: nothing here knows them.
using IrisSession.Core;
using UnityEngine;

namespace IrisSession.Unity
{
    /// <summary>Conversions without choices.</summary>
    public static class UnityValues
    {
        public static Vector3 ToVector3(Float3 value) { return new Vector3(value.X, value.Y, value.Z); }

        public static Vector4 ToVector4(Float3 value, float w) { return new Vector4(value.X, value.Y, value.Z, w); }

        public static Quaternion ToQuaternion(FloatQuaternion value) { return new Quaternion(value.X, value.Y, value.Z, value.W); }

        /// <summary>Place a transform in its parent's frame at a pose of the wire.</summary>
        public static void Place(Transform transform, RigidTransform pose)
        {
            UnityPose placed = UnityAxes.ToUnity(pose);
            transform.SetLocalPositionAndRotation(ToVector3(placed.Position), ToQuaternion(placed.Rotation));
        }

        /// <summary>Return the matrix of a pose of the wire.</summary>
        public static Matrix4x4 ToMatrix(RigidTransform pose)
        {
            UnityPose placed = UnityAxes.ToUnity(pose);
            return Matrix4x4.TRS(ToVector3(placed.Position), ToQuaternion(placed.Rotation), Vector3.one);
        }

        /// <summary>Return the box between two corners.</summary>
        public static Bounds ToBounds(Float3 low, Float3 high)
        {
            Vector3 a = ToVector3(low), b = ToVector3(high);
            return new Bounds(0.5f * (a + b), b - a);
        }

        /// <summary>Return a colour of 0 to 1. A vector, which shaders get as it is: the engine would convert a `Color`.</summary>
        public static Vector4 ToVector4(double[] rgba) { return new Vector4((float)rgba[0], (float)rgba[1], (float)rgba[2], (float)rgba[3]); }

        /// <summary>Return the colour 0xRRGGBB.</summary>
        public static Vector4 ToVector4(int rgb, float alpha)
        {
            return new Vector4(((rgb >> 16) & 255) / 255f, ((rgb >> 8) & 255) / 255f, (rgb & 255) / 255f, alpha);
        }
    }
}
