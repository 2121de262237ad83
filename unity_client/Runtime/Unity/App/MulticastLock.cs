// Android passes on no broadcasts, and so no beacons, unless an app holds a multicast lock. It costs battery: only while it is searched.
using System;
using UnityEngine;

namespace IrisSession.Unity.App
{
    /// <summary>The lock of `android.net.wifi.WifiManager`. Needs the permission CHANGE_WIFI_MULTICAST_STATE. On other systems it does nothing.</summary>
    public sealed class MulticastLock
    {
        private AndroidJavaObject held;
        private bool isWanted;

        /// <summary>Why the system refused, for a log; empty while it has not.</summary>
        public string Problem { get; private set; } = "";

        /// <summary>Hold it, or let it go. Calls that change nothing cost nothing.</summary>
        public void Hold(bool isWanted)
        {
            if (isWanted == this.isWanted || Application.platform != RuntimePlatform.Android) return;
            this.isWanted = isWanted;
            try
            {
                if (isWanted) Acquire();
                else Release();
            }
            catch (Exception error)
            {
                Problem = error.Message; // such as the lack of the permission: addresses still work
            }
        }

        private void Acquire()
        {
            using (AndroidJavaClass player = new AndroidJavaClass("com.unity3d.player.UnityPlayer"))
            using (AndroidJavaObject activity = player.GetStatic<AndroidJavaObject>("currentActivity"))
            using (AndroidJavaObject wifi = activity.Call<AndroidJavaObject>("getSystemService", "wifi"))
            {
                held = wifi.Call<AndroidJavaObject>("createMulticastLock", "iris-session");
            }
            held.Call("setReferenceCounted", false);
            held.Call("acquire");
        }

        private void Release()
        {
            if (held == null) return;
            held.Call("release");
            held.Dispose();
            held = null;
        }
    }
}
