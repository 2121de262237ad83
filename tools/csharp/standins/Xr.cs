// Subsystems of XR: tests add those that a device has.
using System;
using System.Collections.Generic;
using Standins;

namespace Standins
{
    public static class Subsystems
    {
        /// <summary>Those that the loader has made: components start them.</summary>
        public static readonly List<UnityEngine.ISubsystem> Loaded = new List<UnityEngine.ISubsystem>();

        /// <summary>Those that run now.</summary>
        public static readonly List<UnityEngine.ISubsystem> Running = new List<UnityEngine.ISubsystem>();
    }
}

namespace UnityEngine
{
    public interface ISubsystem
    {
        bool running { get; }
    }

    public class IntegratedSubsystem : ISubsystem
    {
        public bool running { get { return Subsystems.Running.Contains(this); } }
    }

    public class IntegratedSubsystem<TSubsystemDescriptor> : IntegratedSubsystem
    {
    }

    public static class SubsystemManager
    {
        public static void GetSubsystems<T>(List<T> subsystems) where T : ISubsystem
        {
            subsystems.Clear();
            foreach (ISubsystem one in Subsystems.Running) if (one is T found) subsystems.Add(found);
        }
    }

    public enum BatteryStatus
    {
        Unknown = 0,
        Charging = 1,
        Discharging = 2,
        NotCharging = 3,
        Full = 4,
    }

    public sealed class SystemInfo
    {
        internal static float Battery = -1f;
        internal static BatteryStatus Status = BatteryStatus.Unknown;

        public static string deviceName { get { Engine.CheckThread(); return "a stand-in"; } }

        public static float batteryLevel { get { Engine.CheckThread(); return Battery; } }

        public static BatteryStatus batteryStatus { get { Engine.CheckThread(); return Status; } }
    }
}

namespace UnityEngine.SubsystemsImplementation
{
    public abstract class SubsystemWithProvider : ISubsystem
    {
        public bool running { get { return Subsystems.Running.Contains(this); } }

        public void Start() { Subsystems.Running.Add(this); }

        public void Stop() { Subsystems.Running.Remove(this); }
    }

    public abstract class SubsystemWithProvider<TSubsystem, TSubsystemDescriptor, TProvider> : SubsystemWithProvider
    {
        public TSubsystemDescriptor subsystemDescriptor { get; internal set; }
    }
}

namespace UnityEngine.XR
{
    public class XRInputSubsystemDescriptor
    {
    }

    public class XRInputSubsystem : IntegratedSubsystem<XRInputSubsystemDescriptor>
    {
        public event Action<XRInputSubsystem> trackingOriginUpdated;

        internal void Recentre() { trackingOriginUpdated?.Invoke(this); }
    }

    public class XRDisplaySubsystemDescriptor
    {
    }

    public class XRDisplaySubsystem : IntegratedSubsystem<XRDisplaySubsystemDescriptor>
    {
        internal int Dropped;

        public bool TryGetDroppedFrameCount(out int droppedFrameCount)
        {
            droppedFrameCount = Dropped;
            return true;
        }
    }
}
