// What the engine knows of the headset beside poses: battery, dropped frames, recentring.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Interaction;
using UnityEngine;
using UnityEngine.XR;

namespace IrisSession.Unity.Input
{
    /// <summary>Battery and frames, and when the tracking frame moves.</summary>
    public sealed class DeviceCondition : IHealthSource, IDisposable
    {
        private readonly List<XRDisplaySubsystem> displays = new List<XRDisplaySubsystem>();
        private readonly List<XRInputSubsystem> inputs = new List<XRInputSubsystem>();
        private readonly List<XRInputSubsystem> listened = new List<XRInputSubsystem>();
        private readonly AndroidThermal android = new AndroidThermal();
        private readonly Action<XRInputSubsystem> moved;

        /// <summary>`ThermalState` by something of the application that knows better than the system, null: nothing does.</summary>
        public Func<string> Thermal { get; set; }

        public DeviceCondition()
        {
            moved = _ => HasMoved = true;
        }

        /// <summary>The tracking frame has moved since this was last cleared: it may be reported several times at once.</summary>
        public bool HasMoved { get; set; }

        /// <summary>Listen to subsystems, which come and go with the loader; one that comes later has another tracking frame. Each frame.</summary>
        public void Refresh()
        {
            SubsystemManager.GetSubsystems(inputs);
            for (int i = 0; i < inputs.Count; i++)
            {
                if (listened.Contains(inputs[i])) continue;
                HasMoved |= listened.Count > 0;
                inputs[i].trackingOriginUpdated += moved;
                listened.Add(inputs[i]);
            }
        }

        public DeviceHealth Read()
        {
            DeviceHealth health = DeviceHealth.Unknown;
            health.Battery = SystemInfo.batteryLevel;
            BatteryStatus status = SystemInfo.batteryStatus;
            health.IsCharging = status == BatteryStatus.Charging || status == BatteryStatus.Full;
            health.Thermal = Thermal == null ? android.Read() : Thermal();
            SubsystemManager.GetSubsystems(displays);
            foreach (XRDisplaySubsystem display in displays)
            {
                if (display.running && display.TryGetDroppedFrameCount(out int dropped)) health.DroppedFrames = dropped;
            }
            return health;
        }

        public void Dispose()
        {
            foreach (XRInputSubsystem one in listened) one.trackingOriginUpdated -= moved;
            listened.Clear();
            android.Dispose();
        }
    }
}
