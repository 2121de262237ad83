// Matrices of the engine: columns are the images of the axes, points are columns on the right.
namespace UnityEngine
{
    public struct Matrix4x4
    {
        // In the engine's order: column after column.
        public float m00;
        public float m10;
        public float m20;
        public float m30;
        public float m01;
        public float m11;
        public float m21;
        public float m31;
        public float m02;
        public float m12;
        public float m22;
        public float m32;
        public float m03;
        public float m13;
        public float m23;
        public float m33;

        public Matrix4x4(Vector4 column0, Vector4 column1, Vector4 column2, Vector4 column3)
        {
            m00 = column0.x;
            m10 = column0.y;
            m20 = column0.z;
            m30 = column0.w;
            m01 = column1.x;
            m11 = column1.y;
            m21 = column1.z;
            m31 = column1.w;
            m02 = column2.x;
            m12 = column2.y;
            m22 = column2.z;
            m32 = column2.w;
            m03 = column3.x;
            m13 = column3.y;
            m23 = column3.z;
            m33 = column3.w;
        }

        public static Matrix4x4 identity
        {
            get
            {
                Matrix4x4 matrix = default;
                matrix.m00 = matrix.m11 = matrix.m22 = matrix.m33 = 1f;
                return matrix;
            }
        }

        /// <summary>The inverse of a matrix that keeps the last row 0 0 0 1; others are not needed here.</summary>
        public Matrix4x4 inverse
        {
            get
            {
                double c00 = (double)m11 * m22 - (double)m12 * m21;
                double c01 = (double)m12 * m20 - (double)m10 * m22;
                double c02 = (double)m10 * m21 - (double)m11 * m20;
                double scale = 1.0 / (m00 * c00 + m01 * c01 + m02 * c02);
                Matrix4x4 to = default;
                to.m00 = (float)(scale * c00);
                to.m10 = (float)(scale * c01);
                to.m20 = (float)(scale * c02);
                to.m01 = (float)(scale * ((double)m02 * m21 - (double)m01 * m22));
                to.m11 = (float)(scale * ((double)m00 * m22 - (double)m02 * m20));
                to.m21 = (float)(scale * ((double)m01 * m20 - (double)m00 * m21));
                to.m02 = (float)(scale * ((double)m01 * m12 - (double)m02 * m11));
                to.m12 = (float)(scale * ((double)m02 * m10 - (double)m00 * m12));
                to.m22 = (float)(scale * ((double)m00 * m11 - (double)m01 * m10));
                Vector3 moved = to.MultiplyVector(new Vector3(m03, m13, m23));
                to.m03 = -moved.x;
                to.m13 = -moved.y;
                to.m23 = -moved.z;
                to.m33 = 1f;
                return to;
            }
        }

        public static Matrix4x4 TRS(Vector3 pos, Quaternion q, Vector3 s)
        {
            Vector3 x = q * new Vector3(s.x, 0f, 0f);
            Vector3 y = q * new Vector3(0f, s.y, 0f);
            Vector3 z = q * new Vector3(0f, 0f, s.z);
            Matrix4x4 matrix = default;
            matrix.m00 = x.x;
            matrix.m10 = x.y;
            matrix.m20 = x.z;
            matrix.m01 = y.x;
            matrix.m11 = y.y;
            matrix.m21 = y.z;
            matrix.m02 = z.x;
            matrix.m12 = z.y;
            matrix.m22 = z.z;
            matrix.m03 = pos.x;
            matrix.m13 = pos.y;
            matrix.m23 = pos.z;
            matrix.m33 = 1f;
            return matrix;
        }

        public static Matrix4x4 operator *(Matrix4x4 lhs, Matrix4x4 rhs)
        {
            Matrix4x4 to = default;
            to.m00 = lhs.m00 * rhs.m00 + lhs.m01 * rhs.m10 + lhs.m02 * rhs.m20 + lhs.m03 * rhs.m30;
            to.m10 = lhs.m10 * rhs.m00 + lhs.m11 * rhs.m10 + lhs.m12 * rhs.m20 + lhs.m13 * rhs.m30;
            to.m20 = lhs.m20 * rhs.m00 + lhs.m21 * rhs.m10 + lhs.m22 * rhs.m20 + lhs.m23 * rhs.m30;
            to.m30 = lhs.m30 * rhs.m00 + lhs.m31 * rhs.m10 + lhs.m32 * rhs.m20 + lhs.m33 * rhs.m30;
            to.m01 = lhs.m00 * rhs.m01 + lhs.m01 * rhs.m11 + lhs.m02 * rhs.m21 + lhs.m03 * rhs.m31;
            to.m11 = lhs.m10 * rhs.m01 + lhs.m11 * rhs.m11 + lhs.m12 * rhs.m21 + lhs.m13 * rhs.m31;
            to.m21 = lhs.m20 * rhs.m01 + lhs.m21 * rhs.m11 + lhs.m22 * rhs.m21 + lhs.m23 * rhs.m31;
            to.m31 = lhs.m30 * rhs.m01 + lhs.m31 * rhs.m11 + lhs.m32 * rhs.m21 + lhs.m33 * rhs.m31;
            to.m02 = lhs.m00 * rhs.m02 + lhs.m01 * rhs.m12 + lhs.m02 * rhs.m22 + lhs.m03 * rhs.m32;
            to.m12 = lhs.m10 * rhs.m02 + lhs.m11 * rhs.m12 + lhs.m12 * rhs.m22 + lhs.m13 * rhs.m32;
            to.m22 = lhs.m20 * rhs.m02 + lhs.m21 * rhs.m12 + lhs.m22 * rhs.m22 + lhs.m23 * rhs.m32;
            to.m32 = lhs.m30 * rhs.m02 + lhs.m31 * rhs.m12 + lhs.m32 * rhs.m22 + lhs.m33 * rhs.m32;
            to.m03 = lhs.m00 * rhs.m03 + lhs.m01 * rhs.m13 + lhs.m02 * rhs.m23 + lhs.m03 * rhs.m33;
            to.m13 = lhs.m10 * rhs.m03 + lhs.m11 * rhs.m13 + lhs.m12 * rhs.m23 + lhs.m13 * rhs.m33;
            to.m23 = lhs.m20 * rhs.m03 + lhs.m21 * rhs.m13 + lhs.m22 * rhs.m23 + lhs.m23 * rhs.m33;
            to.m33 = lhs.m30 * rhs.m03 + lhs.m31 * rhs.m13 + lhs.m32 * rhs.m23 + lhs.m33 * rhs.m33;
            return to;
        }

        public Vector3 MultiplyPoint3x4(Vector3 point)
        {
            Vector3 turned = MultiplyVector(point);
            return new Vector3(turned.x + m03, turned.y + m13, turned.z + m23);
        }

        public Vector3 MultiplyVector(Vector3 vector)
        {
            return new Vector3(
                m00 * vector.x + m01 * vector.y + m02 * vector.z,
                m10 * vector.x + m11 * vector.y + m12 * vector.z,
                m20 * vector.x + m21 * vector.y + m22 * vector.z);
        }
    }
}
