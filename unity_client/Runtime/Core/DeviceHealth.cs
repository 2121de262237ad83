// Condition of the headset, for the report of the client: a headset that dies in an episode costs the episode.
using System;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>What a headset says of itself. Made anew about once a second.</summary>
    public struct DeviceHealth
    {
        /// <summary>Charge, 0 to 1; -1 where it is not known.</summary>
        public double Battery;
        public bool IsCharging;

        /// <summary>A `ThermalState`, empty where it is not known.</summary>
        public string Thermal;

        /// <summary>Frames that were not drawn in time, since the start; -1 where it is not known.</summary>
        public long DroppedFrames;

        /// <summary>Return the `ThermalState` of a thermal status of Android's PowerManager, 0 none to 6 shutdown; empty for other numbers.</summary>
        public static string ToThermal(int androidStatus)
        {
            if (androidStatus < 0 || androidStatus > 6) return "";
            // 1 light, 2 moderate: little of it is felt; 3 severe and above: frames are lost.
            return androidStatus == 0 ? ThermalState.Nominal : androidStatus <= 2 ? ThermalState.Warm : ThermalState.Hot;
        }

        public static DeviceHealth Unknown { get { return new DeviceHealth { Battery = -1, Thermal = "", DroppedFrames = -1 }; } }
    }

    /// <summary>Puts the condition of the headset into reports.</summary>
    public sealed class HealthMeter
    {
        private long droppedBefore = -1;

        /// <summary>The newest condition.</summary>
        public DeviceHealth Newest { get; set; } = DeviceHealth.Unknown;

        /// <summary>Write it into a report: frames dropped since the report before.</summary>
        public void Fill(ClientReport report)
        {
            DeviceHealth now = Newest;
            bool isKnown = now.Battery >= 0 && now.Battery <= 1; // not a number: neither
            report.Battery = isKnown ? now.Battery : -1;
            report.Charging = now.IsCharging;
            report.Thermal = now.Thermal ?? "";
            // A counter that goes back was begun anew.
            report.DroppedFrames = now.DroppedFrames >= 0 && droppedBefore >= 0 ? Math.Max(0, now.DroppedFrames - droppedBefore) : 0;
            droppedBefore = now.DroppedFrames;
        }
    }
}
