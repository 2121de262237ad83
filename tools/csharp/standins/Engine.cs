// The loop of the engine and what tests see of it. No part of Unity: namespace Standins.
using System;
using System.Collections.Generic;
using System.Reflection;
using System.Threading;
using UnityEngine;

namespace Standins
{
    /// <summary>
    /// Runs frames: Awake and OnEnable when a component is added, Start before its first frame, Update, LateUpdate, Application's
    /// onBeforeRender, then everything is drawn, then destroyed objects are removed. One engine at a time.
    /// </summary>
    public static class Engine
    {
        /// <summary>What a message threw. The engine logs it and goes on with the next object.</summary>
        public static readonly List<Exception> Errors = new List<Exception>();

        /// <summary>Lines of Debug, with their level before them.</summary>
        public static readonly List<string> Log = new List<string>();

        /// <summary>Draw calls of the newest frame.</summary>
        public static readonly List<DrawCall> Draws = new List<DrawCall>();

        /// <summary>Keep the draw calls of every frame in `Draws`. Off: frames allocate nothing of their own.</summary>
        public static bool IsRecording = true;

        /// <summary>False: as the engine draws where a graphics card has no instancing.</summary>
        public static bool HasInstancing = true;

        /// <summary>No message reaches a component: as in the editor while nothing is played.</summary>
        public static bool IsEditing;
        internal static double Now;
        internal static double LastStep;
        internal static int Frame;
        internal static event Action BeforeRender;
        private static readonly List<GameObject> Objects = new List<GameObject>();
        private static readonly List<MonoBehaviour> Behaviours = new List<MonoBehaviour>();
        private static readonly List<UnityEngine.Object> Ended = new List<UnityEngine.Object>();
        private static readonly List<MonoBehaviour> Running = new List<MonoBehaviour>();
        private static Thread thread = Thread.CurrentThread;

        /// <summary>Begin again with nothing, on this thread.</summary>
        public static void Reset()
        {
            thread = Thread.CurrentThread;
            foreach (GameObject one in Objects.ToArray()) one.Release();
            for (int i = 0; i < Ended.Count; i++) Ended[i].Release();
            Objects.Clear();
            Behaviours.Clear();
            Ended.Clear();
            Errors.Clear();
            Log.Clear();
            Draws.Clear();
            IsRecording = HasInstancing = true;
            IsEditing = false;
            BeforeRender = null;
            Now = LastStep = 0.0;
            Frame = 0;
            Shader.ResetGlobals();
        }

        /// <summary>Run one frame, `seconds` after the one before.</summary>
        public static void Step(double seconds = 1.0 / 72.0)
        {
            CheckThread();
            LastStep = seconds;
            Now += seconds;
            Frame++;
            Draws.Clear();
            Running.Clear();
            for (int i = 0; i < Behaviours.Count; i++) Running.Add(Behaviours[i]);
            for (int i = 0; i < Running.Count; i++) if (Running[i].isActiveAndEnabled) Running[i].Messages.StartOnce();
            for (int i = 0; i < Running.Count; i++) if (Running[i].isActiveAndEnabled) Running[i].Messages.Call(Running[i].Messages.Update);
            for (int i = 0; i < Running.Count; i++) if (Running[i].isActiveAndEnabled) Running[i].Messages.Call(Running[i].Messages.LateUpdate);
            BeforeRender?.Invoke();
            if (IsRecording) foreach (GameObject one in Objects) DrawCall.AddRenderers(one, Draws);
            for (int i = 0; i < Ended.Count; i++) Ended[i].Release();
            Ended.Clear();
        }

        /// <summary>Pause the application, as when the headset is taken off or another one comes to the front.</summary>
        public static void Pause(bool isPaused)
        {
            foreach (MonoBehaviour one in Behaviours.ToArray()) one.Messages.Call(one.Messages.OnApplicationPause, isPaused);
        }

        /// <summary>Give or take the focus, as by the system's menu.</summary>
        public static void Focus(bool hasFocus)
        {
            foreach (MonoBehaviour one in Behaviours.ToArray()) one.Messages.Call(one.Messages.OnApplicationFocus, hasFocus);
        }

        /// <summary>Members of the engine are used on its thread alone.</summary>
        public static void CheckThread()
        {
            if (Thread.CurrentThread != thread) throw new InvalidOperationException("this can only be called from the main thread");
        }

        internal static void Add(GameObject one) { Objects.Add(one); }

        internal static GameObject[] FindRoots() { return Objects.FindAll(one => one.transform.parent == null).ToArray(); }

        internal static void Remove(GameObject one) { Objects.Remove(one); }

        internal static void Destroy(UnityEngine.Object one)
        {
            CheckThread();
            if (!(one is null) && !Ended.Contains(one)) Ended.Add(one);
        }

        internal static void Start(MonoBehaviour behaviour)
        {
            int at = Behaviours.Count;
            while (at > 0 && Behaviours[at - 1].Messages.Order > behaviour.Messages.Order) at--;
            Behaviours.Insert(at, behaviour);
            behaviour.Messages.UpdateEnabled();
        }

        internal static void End(MonoBehaviour behaviour)
        {
            behaviour.Messages.EndOnce();
            Behaviours.Remove(behaviour);
        }

        internal static void UpdateEnabled(GameObject one)
        {
            foreach (Component each in one.Components.ToArray()) if (each is MonoBehaviour behaviour) behaviour.Messages.UpdateEnabled();
            for (int i = 0; i < one.transform.childCount; i++) UpdateEnabled(one.transform.GetChild(i).gameObject);
        }
    }

    /// <summary>Messages of one behaviour, found by their names as the engine does, and which of them it has had.</summary>
    internal sealed class Messages
    {
        public readonly int Order;
        public readonly Action Update;
        public readonly Action LateUpdate;
        public readonly Action<bool> OnApplicationPause;
        public readonly Action<bool> OnApplicationFocus;
        public readonly CancellationTokenSource Destroyed = new CancellationTokenSource();
        private readonly MonoBehaviour behaviour;
        private bool isAwake;
        private bool isStarted;
        private bool isEnabled;
        private bool isEnded;

        public Messages(MonoBehaviour behaviour)
        {
            this.behaviour = behaviour;
            Update = Find<Action>("Update");
            LateUpdate = Find<Action>("LateUpdate");
            OnApplicationPause = Find<Action<bool>>("OnApplicationPause");
            OnApplicationFocus = Find<Action<bool>>("OnApplicationFocus");
            foreach (DefaultExecutionOrder one in behaviour.GetType().GetCustomAttributes(typeof(DefaultExecutionOrder), true)) Order = one.order;
        }

        public void UpdateEnabled()
        {
            if (isEnded || Engine.IsEditing) return;
            bool isOn = behaviour.isActiveAndEnabled;
            if (!isAwake && behaviour.gameObject.activeInHierarchy)
            {
                isAwake = true;
                Call(Find<Action>("Awake"));
                isOn = behaviour.isActiveAndEnabled;
            }
            if (isOn == isEnabled) return;
            isEnabled = isOn;
            Call(Find<Action>(isOn ? "OnEnable" : "OnDisable"));
        }

        public void StartOnce()
        {
            if (isStarted) return;
            isStarted = true;
            Call(Find<Action>("Start"));
        }

        public void EndOnce()
        {
            if (isEnded) return;
            isEnded = true;
            if (isEnabled) Call(Find<Action>("OnDisable"));
            if (isAwake) Call(Find<Action>("OnDestroy"));
            Destroyed.Cancel();
        }

        public void Call(Action message)
        {
            if (message == null) return;
            try
            {
                message();
            }
            catch (Exception error)
            {
                Engine.Errors.Add(error);
            }
        }

        public void Call(Action<bool> message, bool value)
        {
            if (message != null && behaviour.isActiveAndEnabled) Call(() => message(value));
        }

        private T Find<T>(string name) where T : Delegate
        {
            for (Type type = behaviour.GetType(); type != typeof(MonoBehaviour); type = type.BaseType)
            {
                MethodInfo method = type.GetMethod(name, BindingFlags.Instance | BindingFlags.Public | BindingFlags.NonPublic | BindingFlags.DeclaredOnly);
                if (method != null) return (T)Delegate.CreateDelegate(typeof(T), behaviour, method);
            }
            return null;
        }
    }
}
