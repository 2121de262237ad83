// What a headset has to offer, without its engine: each port has an implementation in a layer, and one in the tests. Ports are used
// on one thread, the engine's.
using System.Collections.Generic;
using IrisSession.Core;

namespace IrisSession.Interaction
{
    /// <summary>Poses and buttons of a headset, in the axes of the wire.</summary>
    public interface IDeviceReader
    {
        /// <summary>Fill a reading. A device that is lost keeps its last pose and is not tracked.</summary>
        void Read(HeadsetReading reading);
    }

    /// <summary>Joints of bare hands, in the axes of the wire.</summary>
    public interface IHands
    {
        /// <summary>Whether the runtime has hands at all, and the person has allowed them.</summary>
        bool IsSupported { get; }

        /// <summary>Fill the reading of a side if a bare hand is there now. Returns whether one is.</summary>
        bool TryRead(Side side, bool wantsJoints, InputReading reading);
    }

    /// <summary>Why there are no codes.</summary>
    public enum MarkerSupport
    {
        Ready,

        /// <summary>Nothing on this device reads codes.</summary>
        Missing,

        /// <summary>The person has not answered, or has refused.</summary>
        NotAllowed,
        Starting,
    }

    /// <summary>QR codes that the runtime tracks.</summary>
    public interface IMarkerSource
    {
        MarkerSupport Support { get; }

        /// <summary>An `ObservationSource`.</summary>
        string Source { get; }

        /// <summary>Fill reports of the codes that have changed since the last call; more reports than the list has are made. Returns how many.</summary>
        int Read(List<MarkerReport> reports);

        /// <summary>Codes cost performance: stop once the person is aligned, begin again when it is asked for.</summary>
        void SetActive(bool isActive);
    }

    /// <summary>The view of the room.</summary>
    public interface IPassthrough
    {
        bool IsSupported { get; }

        bool IsOn { get; set; }
    }

    /// <summary>Where the eyes look.</summary>
    public interface IGaze
    {
        /// <summary>Return `T_tracking_gaze`, which looks along x; false while the runtime does not know it, or may not say it.</summary>
        bool TryRead(out RigidTransform T_tracking_gaze);
    }

    /// <summary>Vibration motors of controllers.</summary>
    public interface IHaptics
    {
        void Play(Side side, Pulse pulse);
    }

    public interface IHealthSource
    {
        DeviceHealth Read();
    }
}
