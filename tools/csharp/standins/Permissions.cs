// Permissions of Android: tests give the wearer's answer.
using System.Collections.Generic;

namespace UnityEngine.Android
{
    public struct Permission
    {
        internal static readonly HashSet<string> Granted = new HashSet<string>();
        internal static readonly List<string> Requested = new List<string>();

        public static bool HasUserAuthorizedPermission(string permission) { return Granted.Contains(permission); }

        public static void RequestUserPermission(string permission) { Requested.Add(permission); }
    }
}
