// The application, its clock and its log.
using System;
using Standins;

namespace UnityEngine
{
    public class Application
    {
        public static string dataPath { get { return DataPath; } }

        public static string persistentDataPath { get { Engine.CheckThread(); return PersistentDataPath; } }

        public static RuntimePlatform platform { get { return Platform; } }

        public static string version { get { Engine.CheckThread(); return "1.0"; } }

        internal static string DataPath = "";
        internal static string PersistentDataPath = "";
        internal static RuntimePlatform Platform = RuntimePlatform.LinuxPlayer;
    }

    public enum RuntimePlatform
    {
        Android = 11,
        LinuxPlayer = 13,
        WSAPlayerX64 = 19,
        WSAPlayerARM = 20,
    }

    public class Time
    {
        /// <summary>Real seconds since the start; the engine's other clocks stop with it.</summary>
        public static double realtimeSinceStartupAsDouble { get { Engine.CheckThread(); return Engine.Now; } }

        public static float deltaTime { get { Engine.CheckThread(); return (float)Engine.LastStep; } }

        public static int frameCount { get { Engine.CheckThread(); return Engine.Frame; } }
    }

    public class Debug
    {
        public static void Log(object message) { Engine.Log.Add("info: " + message); }

        public static void LogWarning(object message) { Engine.Log.Add("warning: " + message); }

        public static void LogError(object message) { Engine.Log.Add("error: " + message); }

        public static void LogException(Exception exception) { Engine.Errors.Add(exception); }
    }
}
