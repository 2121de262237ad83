// Vectors, rotations and rigid transforms as on the wire: right-handed, Z up, metres, quaternions [w, x, y, z], float64.
// What becomes of them in Unity is in UnityAxes.cs.
using System;

namespace IrisSession.Core
{
    /// <summary>A point or vector of three float64, in any right-handed frame.</summary>
    public readonly struct Double3 : IEquatable<Double3>
    {
        public readonly double X;
        public readonly double Y;
        public readonly double Z;

        public Double3(double x, double y, double z)
        {
            X = x;
            Y = y;
            Z = z;
        }

        /// <summary>Length, in the unit of the components.</summary>
        public double Length { get { return Math.Sqrt(Dot(this, this)); } }

        public static double Dot(Double3 a, Double3 b)
        {
            return a.X * b.X + a.Y * b.Y + a.Z * b.Z;
        }

        public static Double3 Cross(Double3 a, Double3 b)
        {
            return new Double3(a.Y * b.Z - a.Z * b.Y, a.Z * b.X - a.X * b.Z, a.X * b.Y - a.Y * b.X);
        }

        public static Double3 operator +(Double3 a, Double3 b) { return new Double3(a.X + b.X, a.Y + b.Y, a.Z + b.Z); }

        public static Double3 operator -(Double3 a, Double3 b) { return new Double3(a.X - b.X, a.Y - b.Y, a.Z - b.Z); }

        public static Double3 operator -(Double3 a) { return new Double3(-a.X, -a.Y, -a.Z); }

        public static Double3 operator *(double s, Double3 a) { return new Double3(s * a.X, s * a.Y, s * a.Z); }

        public bool Equals(Double3 other) { return X.Equals(other.X) && Y.Equals(other.Y) && Z.Equals(other.Z); }

        public override bool Equals(object other) { return other is Double3 value && Equals(value); }

        public override int GetHashCode() { return X.GetHashCode() ^ (Y.GetHashCode() * 397) ^ (Z.GetHashCode() * 17); }

        public override string ToString() { return "(" + X + ", " + Y + ", " + Z + ")"; }
    }

    /// <summary>A rotation [w, x, y, z] of unit length. The default value is no rotation: use <see cref="Identity"/>.</summary>
    public readonly struct DoubleQuaternion : IEquatable<DoubleQuaternion>
    {
        public readonly double W;
        public readonly double X;
        public readonly double Y;
        public readonly double Z;

        public DoubleQuaternion(double w, double x, double y, double z)
        {
            W = w;
            X = x;
            Y = y;
            Z = z;
        }

        public static DoubleQuaternion Identity { get { return new DoubleQuaternion(1.0, 0.0, 0.0, 0.0); } }

        /// <summary>The inverse of a rotation of unit length.</summary>
        public DoubleQuaternion Conjugate { get { return new DoubleQuaternion(W, -X, -Y, -Z); } }

        /// <summary>The same rotation with unit length; the identity where the length is 0 or not finite.</summary>
        public DoubleQuaternion Normalized
        {
            get
            {
                double length = Math.Sqrt(W * W + X * X + Y * Y + Z * Z);
                if (!(length > 1e-12) || double.IsInfinity(length)) return Identity;
                return new DoubleQuaternion(W / length, X / length, Y / length, Z / length);
            }
        }

        /// <summary>Return the rotation by `angle` [rad] about `axis`, by the right-hand rule.</summary>
        public static DoubleQuaternion FromAxisAngle(Double3 axis, double angle)
        {
            double s = Math.Sin(0.5 * angle) / axis.Length;
            return new DoubleQuaternion(Math.Cos(0.5 * angle), s * axis.X, s * axis.Y, s * axis.Z);
        }

        /// <summary>Return the rotation that applies `b`, then `a`.</summary>
        public static DoubleQuaternion operator *(DoubleQuaternion a, DoubleQuaternion b)
        {
            return new DoubleQuaternion(
                a.W * b.W - a.X * b.X - a.Y * b.Y - a.Z * b.Z,
                a.W * b.X + a.X * b.W + a.Y * b.Z - a.Z * b.Y,
                a.W * b.Y - a.X * b.Z + a.Y * b.W + a.Z * b.X,
                a.W * b.Z + a.X * b.Y - a.Y * b.X + a.Z * b.W);
        }

        /// <summary>Return `v` rotated.</summary>
        public Double3 Rotate(Double3 v)
        {
            Double3 u = new Double3(X, Y, Z);
            Double3 t = 2.0 * Double3.Cross(u, v);
            return v + W * t + Double3.Cross(u, t);
        }

        /// <summary>Return the angle of the rotation from `a` to `b` [rad], 0 to pi.</summary>
        public static double Angle(DoubleQuaternion a, DoubleQuaternion b)
        {
            DoubleQuaternion d = a.Conjugate * b;
            return 2.0 * Math.Atan2(Math.Sqrt(d.X * d.X + d.Y * d.Y + d.Z * d.Z), Math.Abs(d.W));
        }

        public bool Equals(DoubleQuaternion other)
        {
            return W.Equals(other.W) && X.Equals(other.X) && Y.Equals(other.Y) && Z.Equals(other.Z);
        }

        public override bool Equals(object other) { return other is DoubleQuaternion value && Equals(value); }

        public override int GetHashCode() { return W.GetHashCode() ^ (X.GetHashCode() * 397) ^ (Y.GetHashCode() * 17) ^ (Z.GetHashCode() * 5); }

        public override string ToString() { return "[" + W + ", " + X + ", " + Y + ", " + Z + "]"; }
    }

    /// <summary>A pose `T_a_b`: it maps points of frame b into frame a. Position in metres.</summary>
    public readonly struct RigidTransform : IEquatable<RigidTransform>
    {
        public readonly Double3 Position;
        public readonly DoubleQuaternion Rotation;

        public RigidTransform(Double3 position, DoubleQuaternion rotation)
        {
            Position = position;
            Rotation = rotation;
        }

        public static RigidTransform Identity { get { return new RigidTransform(default, DoubleQuaternion.Identity); } }

        /// <summary>`T_b_a` of `T_a_b`.</summary>
        public RigidTransform Inverse
        {
            get
            {
                DoubleQuaternion back = Rotation.Conjugate;
                return new RigidTransform(-back.Rotate(Position), back);
            }
        }

        /// <summary>Return `T_a_c` of `T_a_b` and `T_b_c`.</summary>
        public static RigidTransform operator *(RigidTransform a, RigidTransform b)
        {
            return new RigidTransform(a.TransformPoint(b.Position), a.Rotation * b.Rotation);
        }

        /// <summary>Return a point of frame b in frame a.</summary>
        public Double3 TransformPoint(Double3 point)
        {
            return Position + Rotation.Rotate(point);
        }

        /// <summary>Read row `index` of rows `x y z qw qx qy qz`.</summary>
        public static RigidTransform FromRow(double[] rows, int index)
        {
            int at = 7 * index;
            return new RigidTransform(
                new Double3(rows[at], rows[at + 1], rows[at + 2]),
                new DoubleQuaternion(rows[at + 3], rows[at + 4], rows[at + 5], rows[at + 6]));
        }

        /// <summary>Write row `index` of rows `x y z qw qx qy qz`.</summary>
        public void WriteRow(double[] rows, int index)
        {
            int at = 7 * index;
            rows[at] = Position.X;
            rows[at + 1] = Position.Y;
            rows[at + 2] = Position.Z;
            rows[at + 3] = Rotation.W;
            rows[at + 4] = Rotation.X;
            rows[at + 5] = Rotation.Y;
            rows[at + 6] = Rotation.Z;
        }

        public bool Equals(RigidTransform other) { return Position.Equals(other.Position) && Rotation.Equals(other.Rotation); }

        public override bool Equals(object other) { return other is RigidTransform value && Equals(value); }

        public override int GetHashCode() { return Position.GetHashCode() ^ Rotation.GetHashCode(); }

        public override string ToString() { return Position + " " + Rotation; }
    }
}
