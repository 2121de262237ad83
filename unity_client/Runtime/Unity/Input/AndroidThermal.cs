// Heat of an Android headset, by the system's PowerManager: it needs no package, and is there in every editor and since Android 10.
using System;
using IrisSession.Core;
using UnityEngine;

namespace IrisSession.Unity.Input
{
    /// <summary>Asks the system how hot the device is. For the engine's thread; a call into Java, so once a second is often enough.</summary>
    public sealed class AndroidThermal : IDisposable
    {
        private AndroidJavaObject power;
        private bool isMissing;

        /// <summary>Return a `ThermalState`, empty where the system does not say.</summary>
        public string Read()
        {
            if (isMissing || Application.platform != RuntimePlatform.Android) return "";
            try
            {
                if (power == null) power = FindPower();
                return DeviceHealth.ToThermal(power.Call<int>("getCurrentThermalStatus"));
            }
            catch (Exception) // of Java: the method, or the service, is not there
            {
                isMissing = true;
                return "";
            }
        }

        public void Dispose()
        {
            power?.Dispose();
            power = null;
        }

        private static AndroidJavaObject FindPower()
        {
            using (AndroidJavaClass player = new AndroidJavaClass("com.unity3d.player.UnityPlayer"))
            using (AndroidJavaObject activity = player.GetStatic<AndroidJavaObject>("currentActivity"))
                return activity.Call<AndroidJavaObject>("getSystemService", "power");
        }
    }
}
