// Axes of QR codes as runtimes report them in Unity, made one: the sheet's own on the wire.
//
// A sheet has its origin in the centre of the code, x to the right, y to the top edge, z out of the paper. Sources, as read
// in their sources and manuals (shared facts, section 5): none has been seen on a headset.
using System;

namespace IrisSession.Core
{
    /// <summary>A code as its runtime reports it, converted: `T_tracking_anchor` in the axes of the wire.</summary>
    public readonly struct MarkerPose
    {
        public readonly RigidTransform T_tracking_anchor;

        /// <summary>Edge as the runtime measures it [m]; 0 where it is not known, or the code is not square.</summary>
        public readonly double SizeM;

        public MarkerPose(RigidTransform T_tracking_anchor, double sizeM)
        {
            this.T_tracking_anchor = T_tracking_anchor;
            SizeM = sizeM;
        }
    }

    /// <summary>Converts poses of codes in the tracking frame of Unity (of the XR origin, not of the scene).</summary>
    public static class MarkerAxes
    {
        /// <summary>Edges that differ by more than this are not those of a code that was located.</summary>
        private const double MaxEdgeRatio = 1.2;

        // Rotations from the sheet's frame to the runtime's local one, both in the axes of the wire: where right, top and normal point.
        private static readonly DoubleQuaternion FoundationFromSheet = new DoubleQuaternion(Math.Sqrt(0.5), 0, 0, -Math.Sqrt(0.5));
        private static readonly DoubleQuaternion MrukFromSheet = new DoubleQuaternion(0.5, 0.5, 0.5, 0.5);
        private static readonly DoubleQuaternion MicrosoftFromSheet = new DoubleQuaternion(0.5, -0.5, 0.5, -0.5);

        /// <summary>Convert an `ARMarker` of AR Foundation: origin in the centre, +X right, +Y out of the paper, +Z top.</summary>
        /// <param name="pose">In the tracking frame.</param>
        /// <param name="sizeX">`ARMarker.size.x`, along X [m].</param>
        /// <param name="sizeY">`ARMarker.size.y`, along Z [m].</param>
        public static MarkerPose FromArFoundation(UnityPose pose, double sizeX, double sizeY)
        {
            return Convert(pose, default, FoundationFromSheet, sizeX, sizeY);
        }

        /// <summary>Convert an `MRUKTrackable`: +X left, +Y top, +Z out of the paper; the centre is that of `PlaneRect`.</summary>
        /// <param name="pose">In the tracking frame.</param>
        /// <param name="centerX">Centre of `PlaneRect` in the local frame [m].</param>
        /// <param name="centerY">The same along Y.</param>
        /// <param name="width">Of `PlaneRect` [m].</param>
        /// <param name="height">Of `PlaneRect` [m].</param>
        public static MarkerPose FromMruk(UnityPose pose, double centerX, double centerY, double width, double height)
        {
            return Convert(pose, new Float3((float)centerX, (float)centerY, 0), MrukFromSheet, width, height);
        }

        /// <summary>
        /// Convert an `ARMarker` of Microsoft's plugin in `TransformMode.MostStable`: origin in the top left corner of the code, +X
        /// right, +Y down, +Z out of the paper; `center` says where the centre is.
        /// </summary>
        public static MarkerPose FromMicrosoftMostStable(UnityPose pose, double centerX, double centerY, double width, double height)
        {
            return Convert(pose, new Float3((float)centerX, (float)centerY, 0), MicrosoftFromSheet, width, height);
        }

        /// <summary>Convert the same in `TransformMode.Center`: its origin is the centre.</summary>
        public static MarkerPose FromMicrosoftCenter(UnityPose pose, double width, double height)
        {
            return Convert(pose, default, MicrosoftFromSheet, width, height);
        }

        private static MarkerPose Convert(UnityPose pose, Float3 center, DoubleQuaternion localFromSheet, double width, double height)
        {
            RigidTransform local = UnityAxes.FromUnity(pose);
            RigidTransform sheet = new RigidTransform(local.TransformPoint(UnityAxes.FromUnity(center)), local.Rotation * localFromSheet);
            return new MarkerPose(sheet, Edge(width, height));
        }

        private static double Edge(double width, double height)
        {
            bool isSquare = width > 0 && height > 0 && width < MaxEdgeRatio * height && height < MaxEdgeRatio * width;
            return isSquare ? 0.5 * (width + height) : 0;
        }
    }
}
