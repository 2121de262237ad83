// Objects of Java: tests see which of their methods were called.
using System;
using System.Collections.Generic;
using UnityEngine;

namespace Standins
{
    /// <summary>Calls of methods of Java, by their names.</summary>
    public static class JavaCalls
    {
        public static readonly List<string> All = new List<string>();

        /// <summary>What methods return, by their names, or throw; others return another object.</summary>
        public static readonly Dictionary<string, object> Answers = new Dictionary<string, object>();
    }
}

namespace UnityEngine
{
    public class AndroidJavaObject : IDisposable
    {
        public AndroidJavaObject(string className, params object[] args)
        {
            if (Application.platform != RuntimePlatform.Android) throw new InvalidOperationException("there is no Java here");
        }

        public void Call(string methodName, params object[] args) { Standins.JavaCalls.All.Add(methodName); }

        public ReturnType Call<ReturnType>(string methodName, params object[] args)
        {
            Standins.JavaCalls.All.Add(methodName);
            if (!Standins.JavaCalls.Answers.TryGetValue(methodName, out object answer)) answer = new AndroidJavaObject(methodName);
            return answer is Exception error ? throw error : (ReturnType)answer;
        }

        public FieldType GetStatic<FieldType>(string fieldName) { return (FieldType)(object)new AndroidJavaObject(fieldName); }

        public void Dispose() { }
    }

    public class AndroidJavaClass : AndroidJavaObject
    {
        public AndroidJavaClass(string className) : base(className) { }
    }
}
