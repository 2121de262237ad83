// The stand-ins behave as the manual says where the tests of the layers depend on it.
using System;
using System.Collections.Generic;
using System.Threading;
using NUnit.Framework;
using Standins;
using UnityEngine;
using UnityEngine.Rendering;

namespace IrisSession.Unity.StandinTests
{
    [TestFixture]
    public sealed class StandinTests
    {
        [SetUp]
        public void Begin() { Engine.Reset(); }

        [Test]
        public void FramesAreLeftHanded()
        {
            AssertNear(Vector3.right, Quaternion.AngleAxis(90f, Vector3.up) * Vector3.forward);
            AssertNear(Vector3.forward, Quaternion.AngleAxis(90f, Vector3.right) * Vector3.up);
            AssertNear(Vector3.up, Quaternion.AngleAxis(90f, Vector3.forward) * Vector3.right);
            AssertNear(Vector3.forward, Vector3.Cross(Vector3.right, Vector3.up)); // the sign of the formula, in any frame
        }

        [Test]
        public void PosesGoThroughAllParents()
        {
            Transform parent = new GameObject("parent").transform, child = new GameObject("child").transform;
            child.SetParent(parent, false);
            parent.SetPositionAndRotation(new Vector3(1f, 2f, 3f), Quaternion.AngleAxis(90f, Vector3.up));
            parent.localScale = new Vector3(2f, 3f, 4f);
            child.SetLocalPositionAndRotation(new Vector3(1f, 1f, 1f), Quaternion.AngleAxis(90f, Vector3.right));
            AssertNear(new Vector3(5f, 5f, 1f), child.position); // scaled 2 3 4; then x becomes -z, z becomes x
            AssertNear(child.position, child.localToWorldMatrix.MultiplyPoint3x4(Vector3.zero));
            Vector3 point = new Vector3(0.3f, -0.7f, 2f);
            AssertNear(point, child.InverseTransformPoint(child.TransformPoint(point)));
            AssertNear(Vector3.right, parent.rotation * Vector3.forward);
            child.SetParent(null, true);
            AssertNear(new Vector3(5f, 5f, 1f), child.localPosition);
        }

        private sealed class Recorder : MonoBehaviour
        {
            public static readonly List<string> Calls = new List<string>();

            private void Awake() { Calls.Add("Awake"); }

            private void OnEnable() { Calls.Add("OnEnable"); }

            private void Start() { Calls.Add("Start"); }

            private void Update() { Calls.Add("Update"); }

            private void LateUpdate() { Calls.Add("LateUpdate"); }

            private void OnDisable() { Calls.Add("OnDisable"); }

            private void OnDestroy() { Calls.Add("OnDestroy"); }

            private void OnApplicationPause(bool pauseStatus) { Calls.Add("Pause " + pauseStatus); }
        }

        [Test]
        public void MessagesComeInTheOrderOfTheManual()
        {
            Recorder.Calls.Clear();
            GameObject one = new GameObject("one");
            Recorder recorder = one.AddComponent<Recorder>();
            CollectionAssert.AreEqual(new[] { "Awake", "OnEnable" }, Recorder.Calls);
            Engine.Step();
            Engine.Step();
            Engine.Pause(true);
            one.SetActive(false);
            Engine.Step();
            one.SetActive(true);
            UnityEngine.Object.Destroy(one);
            Assert.IsTrue(recorder != null);
            Engine.Step();
            Assert.IsTrue(recorder == null && one == null);
            CollectionAssert.AreEqual(
                new[] { "Awake", "OnEnable", "Start", "Update", "LateUpdate", "Update", "LateUpdate", "Pause True", "OnDisable", "OnEnable", "Update", "LateUpdate", "OnDisable", "OnDestroy" },
                Recorder.Calls);
        }

        [Test]
        public void MeshesAreTheBytesThatTheyWereGiven()
        {
            Mesh mesh = new Mesh();
            mesh.SetVertexBufferParams(
                2, new VertexAttributeDescriptor(VertexAttribute.Position), new VertexAttributeDescriptor(VertexAttribute.Color, VertexAttributeFormat.UNorm8, 4));
            mesh.SetVertexBufferData(new[] { 1f, 2f, 3f, BitConverter.ToSingle(new byte[] { 10, 20, 30, 40 }, 0), 4f, 5f, 6f, 0f }, 0, 0, 8);
            mesh.SetIndexBufferParams(3, IndexFormat.UInt32);
            mesh.SetIndexBufferData(new[] { 0, 1, 0 }, 0, 0, 3);
            mesh.SetSubMesh(0, new SubMeshDescriptor(0, 3));
            AssertNear(new Vector3(4f, 5f, 6f), mesh.vertices[1]);
            Assert.AreEqual(30, mesh.colors32[0].b);
            CollectionAssert.AreEqual(new[] { 0, 1, 0 }, mesh.triangles);
            mesh.SetIndexBufferData(new[] { 0, 2, 0 }, 0, 0, 3);
            Assert.Throws<ArgumentException>(() => mesh.SetSubMesh(0, new SubMeshDescriptor(0, 3)));
            Assert.Throws<ArgumentException>(() => mesh.SetVertexBufferData(new float[9], 0, 0, 9));
        }

        [Test]
        public void OnlyTheThreadOfTheEngineMayUseIt()
        {
            Transform transform = new GameObject("one").transform;
            Exception caught = null;
            Thread other = new Thread(() =>
            {
                try { transform.localPosition = Vector3.one; }
                catch (InvalidOperationException error) { caught = error; }
            });
            other.Start();
            other.Join();
            Assert.IsNotNull(caught);
        }

        internal static void AssertNear(Vector3 expected, Vector3 actual, float tolerance = 1e-5f)
        {
            Assert.LessOrEqual((expected - actual).magnitude, tolerance, expected + " is not " + actual);
        }
    }
}
