// Objects, game objects and components of the engine. Lives are those of Standins.Engine.
using System;
using System.Collections.Generic;
using System.Threading;
using Standins;

namespace UnityEngine
{
    public class Object
    {
        private string given = "";

        internal bool IsDestroyed { get; set; }

        public string name { get { return given; } set { given = value; } }

        public static void Destroy(Object obj) { Engine.Destroy(obj); }

        /// <summary>A destroyed object equals null.</summary>
        public static bool operator ==(Object x, Object y)
        {
            bool isNoX = x is null || x.IsDestroyed;
            bool isNoY = y is null || y.IsDestroyed;
            return isNoX || isNoY ? isNoX && isNoY : ReferenceEquals(x, y);
        }

        public static bool operator !=(Object x, Object y) { return !(x == y); }

        public static implicit operator bool(Object exists) { return exists != null; }

        public override bool Equals(object other) { return other is Object one ? this == one : other == null && IsDestroyed; }

        public override int GetHashCode() { return System.Runtime.CompilerServices.RuntimeHelpers.GetHashCode(this); }

        internal virtual void Release() { IsDestroyed = true; }
    }

    public sealed class GameObject : Object
    {
        internal readonly List<Component> Components = new List<Component>();
        private bool isActive = true;

        public GameObject() : this("New Game Object") { }

        public GameObject(string name)
        {
            Engine.CheckThread();
            this.name = name;
            transform = AddComponent<Transform>();
            Engine.Add(this);
        }

        public Transform transform { get; private set; }

        public int layer { get; set; }

        public string tag { get; set; } = "Untagged";

        public bool activeSelf { get { return isActive; } }

        public bool activeInHierarchy
        {
            get { return !IsDestroyed && isActive && (transform.parent == null || transform.parent.gameObject.activeInHierarchy); }
        }

        public T AddComponent<T>() where T : Component
        {
            Engine.CheckThread();
            return (T)Create(typeof(T));
        }

        public T GetComponent<T>()
        {
            foreach (Component one in Components) if (one is T found) return found;
            return default;
        }

        public void SetActive(bool value)
        {
            Engine.CheckThread();
            isActive = value;
            Engine.UpdateEnabled(this);
        }

        private void Require(Type type)
        {
            foreach (Component one in Components) if (type.IsInstanceOfType(one)) return;
            Create(type);
        }

        private Component Create(Type type)
        {
            foreach (RequireComponent needed in type.GetCustomAttributes(typeof(RequireComponent), true)) Require(needed.m_Type0);
            Component component = (Component)Activator.CreateInstance(type, true);
            component.Attach(this);
            Components.Add(component);
            if (component is MonoBehaviour behaviour) Engine.Start(behaviour);
            return component;
        }

        internal override void Release()
        {
            if (IsDestroyed) return;
            transform.ReleaseChildren();
            foreach (Component one in Components.ToArray()) one.Release();
            Components.Clear();
            base.Release();
            Engine.Remove(this);
        }
    }

    public class Component : Object
    {
        private GameObject owner;

        public GameObject gameObject { get { return owner; } }

        public Transform transform { get { return owner.transform; } }

        public T GetComponent<T>() { return owner.GetComponent<T>(); }

        internal void Attach(GameObject gameObject)
        {
            owner = gameObject;
            name = gameObject.name;
        }

        internal override void Release()
        {
            if (IsDestroyed) return;
            if (this is MonoBehaviour behaviour) Engine.End(behaviour);
            owner.Components.Remove(this);
            base.Release();
        }
    }

    public class Behaviour : Component
    {
        private bool isEnabled = true;

        public bool enabled
        {
            get { return isEnabled; }
            set
            {
                Engine.CheckThread();
                isEnabled = value;
                Engine.UpdateEnabled(gameObject);
            }
        }

        public bool isActiveAndEnabled { get { return isEnabled && !IsDestroyed && gameObject.activeInHierarchy; } }
    }

    public class MonoBehaviour : Behaviour
    {
        internal readonly Messages Messages;

        public MonoBehaviour()
        {
            Messages = new Messages(this);
        }

        public CancellationToken destroyCancellationToken { get { return Messages.Destroyed.Token; } }
    }

    [AttributeUsage(AttributeTargets.Field)]
    public sealed class SerializeField : Attribute
    {
    }

    [AttributeUsage(AttributeTargets.Class, AllowMultiple = true)]
    public sealed class RequireComponent : Attribute
    {
        public Type m_Type0;

        public RequireComponent(Type requiredComponent)
        {
            m_Type0 = requiredComponent;
        }
    }

    [AttributeUsage(AttributeTargets.Class)]
    public class DefaultExecutionOrder : Attribute
    {
        public DefaultExecutionOrder(int order)
        {
            this.order = order;
        }

        public int order { get; }
    }
}
