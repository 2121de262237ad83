// The one place where right-handed frames with Z up (the wire) become Unity's left-handed ones with Y up, and back.
// docs/protocol.md, section 11. The map mirrors: windings are reversed, and rotations turn the other way about mapped axes.
using System;

namespace IrisSession.Core
{
    /// <summary>Components of a Unity `Vector3`: X right, Y up, Z forward.</summary>
    public readonly struct Float3 : IEquatable<Float3>
    {
        public readonly float X;
        public readonly float Y;
        public readonly float Z;

        public Float3(float x, float y, float z)
        {
            X = x;
            Y = y;
            Z = z;
        }

        public bool Equals(Float3 other) { return X.Equals(other.X) && Y.Equals(other.Y) && Z.Equals(other.Z); }

        public override bool Equals(object other) { return other is Float3 value && Equals(value); }

        public override int GetHashCode() { return X.GetHashCode() ^ (Y.GetHashCode() * 397) ^ (Z.GetHashCode() * 17); }

        public override string ToString() { return "(" + X + ", " + Y + ", " + Z + ")"; }
    }

    /// <summary>Components of a Unity `Quaternion`, in its order.</summary>
    public readonly struct FloatQuaternion : IEquatable<FloatQuaternion>
    {
        public readonly float X;
        public readonly float Y;
        public readonly float Z;
        public readonly float W;

        public FloatQuaternion(float x, float y, float z, float w)
        {
            X = x;
            Y = y;
            Z = z;
            W = w;
        }

        public bool Equals(FloatQuaternion other)
        {
            return X.Equals(other.X) && Y.Equals(other.Y) && Z.Equals(other.Z) && W.Equals(other.W);
        }

        public override bool Equals(object other) { return other is FloatQuaternion value && Equals(value); }

        public override int GetHashCode() { return X.GetHashCode() ^ (Y.GetHashCode() * 397) ^ (Z.GetHashCode() * 17) ^ (W.GetHashCode() * 5); }

        public override string ToString() { return "(" + X + ", " + Y + ", " + Z + ", " + W + ")"; }
    }

    /// <summary>Position [m] and rotation of a Unity transform.</summary>
    public readonly struct UnityPose
    {
        public readonly Float3 Position;
        public readonly FloatQuaternion Rotation;

        public UnityPose(Float3 position, FloatQuaternion rotation)
        {
            Position = position;
            Rotation = rotation;
        }
    }

    /// <summary>Converts between frames of the wire and those of Unity.</summary>
    public static class UnityAxes
    {
        // Rotations from a frame with X forward, Y left, Z up to the same camera in its own axes.
        private static readonly DoubleQuaternion ViewFrame = new DoubleQuaternion(0.5, -0.5, 0.5, 0.5);
        private static readonly DoubleQuaternion OpticalFrame = new DoubleQuaternion(0.5, 0.5, -0.5, 0.5);

        /// <summary>Return a point or direction of the wire in Unity's axes.</summary>
        public static Float3 ToUnity(Double3 point)
        {
            return new Float3((float)-point.Y, (float)point.Z, (float)point.X);
        }

        /// <summary>Return a point or direction of Unity in the axes of the wire.</summary>
        public static Double3 FromUnity(Float3 point)
        {
            return new Double3(point.Z, -point.X, point.Y);
        }

        /// <summary>Return a rotation of the wire in Unity's axes.</summary>
        public static FloatQuaternion ToUnity(DoubleQuaternion rotation)
        {
            return new FloatQuaternion((float)rotation.Y, (float)-rotation.Z, (float)-rotation.X, (float)rotation.W);
        }

        /// <summary>Return a rotation of Unity in the axes of the wire, of unit length in float64.</summary>
        public static DoubleQuaternion FromUnity(FloatQuaternion rotation)
        {
            return new DoubleQuaternion(rotation.W, -(double)rotation.Z, rotation.X, -(double)rotation.Y).Normalized;
        }

        /// <summary>Return a pose of the wire in Unity's axes.</summary>
        public static UnityPose ToUnity(RigidTransform pose)
        {
            return new UnityPose(ToUnity(pose.Position), ToUnity(pose.Rotation));
        }

        /// <summary>Return a pose of Unity in the axes of the wire.</summary>
        public static RigidTransform FromUnity(UnityPose pose)
        {
            return new RigidTransform(FromUnity(pose.Position), FromUnity(pose.Rotation));
        }

        /// <summary>Return the pose in row `index` of rows `x y z qw qx qy qz` in Unity's axes.</summary>
        public static UnityPose RowToUnity(double[] rows, int index)
        {
            return ToUnity(RigidTransform.FromRow(rows, index));
        }

        /// <summary>Return a scale along the axes of the wire as `localScale` of Unity.</summary>
        public static Float3 ScaleToUnity(Double3 scale)
        {
            return new Float3((float)scale.Y, (float)scale.Z, (float)scale.X);
        }

        /// <summary>
        /// Return the pose of a Unity camera, which looks along +Z with +Y up, for a camera of the scene: `T_world_camera` of
        /// a frame that looks along -z with y up.
        /// </summary>
        public static UnityPose CameraToUnity(RigidTransform T_world_camera)
        {
            return ToUnity(new RigidTransform(T_world_camera.Position, T_world_camera.Rotation * ViewFrame));
        }

        /// <summary>Return the pose of a Unity camera for an optical frame: x right, y down, z forward.</summary>
        public static UnityPose OpticalFrameToUnity(RigidTransform T_world_camera)
        {
            return ToUnity(new RigidTransform(T_world_camera.Position, T_world_camera.Rotation * OpticalFrame));
        }

        /// <summary>Return `T_world_camera` (x right, y down, z forward) of the pose of a Unity camera.</summary>
        public static RigidTransform OpticalFrameFromUnity(UnityPose camera)
        {
            RigidTransform pose = FromUnity(camera);
            return new RigidTransform(pose.Position, pose.Rotation * OpticalFrame.Conjugate);
        }

        /// <summary>Convert `count` points or normals of three floats each; `target` may be `source`.</summary>
        public static void PointsToUnity(float[] source, float[] target, int count)
        {
            for (int at = 0; at < 3 * count; at += 3)
            {
                float x = source[at];
                float y = source[at + 1];
                target[at] = -y;
                target[at + 1] = source[at + 2];
                target[at + 2] = x;
            }
        }

        /// <summary>Reverse the winding of triangles, in place: counter-clockwise from outside on the wire, clockwise in Unity.</summary>
        public static void FlipWinding(int[] indices)
        {
            for (int at = 0; at + 2 < indices.Length; at += 3)
            {
                int second = indices[at + 1];
                indices[at + 1] = indices[at + 2];
                indices[at + 2] = second;
            }
        }
    }
}
