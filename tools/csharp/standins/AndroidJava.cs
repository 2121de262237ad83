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
            return (ReturnType)(object)new AndroidJavaObject(methodName);
        }

        public FieldType GetStatic<FieldType>(string fieldName) { return (FieldType)(object)new AndroidJavaObject(fieldName); }

        public void Dispose() { }
    }

    public class AndroidJavaClass : AndroidJavaObject
    {
        public AndroidJavaClass(string className) : base(className) { }
    }
}
