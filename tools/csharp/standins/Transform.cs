// The hierarchy of the engine: local poses, and matrices through all parents.
using System.Collections.Generic;
using Standins;

namespace UnityEngine
{
    public class Transform : Component
    {
        private readonly List<Transform> children = new List<Transform>();
        private Transform above;
        private Vector3 place;
        private Quaternion turn = Quaternion.identity;
        private Vector3 scale = Vector3.one;

        protected Transform()
        {
        }

        public Transform parent { get { return above; } set { SetParent(value, true); } }

        public int childCount { get { return children.Count; } }

        public Vector3 localPosition { get { return place; } set { Check().place = value; } }

        public Quaternion localRotation { get { return turn; } set { Check().turn = value; } }

        public Vector3 localScale { get { return scale; } set { Check().scale = value; } }

        public Vector3 position
        {
            get { return above == null ? place : above.TransformPoint(place); }
            set { Check().place = above == null ? value : above.InverseTransformPoint(value); }
        }

        public Quaternion rotation
        {
            get { return above == null ? turn : above.rotation * turn; }
            set { Check().turn = above == null ? value : Quaternion.Inverse(above.rotation) * value; }
        }

        public Matrix4x4 localToWorldMatrix
        {
            get
            {
                Matrix4x4 local = Matrix4x4.TRS(place, turn, scale);
                return above == null ? local : above.localToWorldMatrix * local;
            }
        }

        public Matrix4x4 worldToLocalMatrix { get { return localToWorldMatrix.inverse; } }

        public Transform GetChild(int index) { return children[index]; }

        public void SetParent(Transform p) { SetParent(p, true); }

        public void SetParent(Transform parent, bool worldPositionStays)
        {
            Check();
            Vector3 wasAt = position;
            Quaternion wasTurned = rotation;
            if (!(above is null)) above.children.Remove(this);
            above = parent;
            if (!(above is null)) above.children.Add(this);
            if (worldPositionStays) SetPositionAndRotation(wasAt, wasTurned);
        }

        public void SetPositionAndRotation(Vector3 position, Quaternion rotation)
        {
            this.position = position;
            this.rotation = rotation;
        }

        public void SetLocalPositionAndRotation(Vector3 localPosition, Quaternion localRotation)
        {
            Check();
            place = localPosition;
            turn = localRotation;
        }

        public Vector3 TransformPoint(Vector3 position) { return localToWorldMatrix.MultiplyPoint3x4(position); }

        public Vector3 InverseTransformPoint(Vector3 position) { return worldToLocalMatrix.MultiplyPoint3x4(position); }

        internal void ReleaseChildren()
        {
            foreach (Transform child in children.ToArray()) child.gameObject.Release();
            if (!(above is null)) above.children.Remove(this);
        }

        private Transform Check()
        {
            Engine.CheckThread();
            if (IsDestroyed) throw new System.InvalidOperationException("a transform was used after its object was destroyed");
            return this;
        }
    }
}
