// Codes of MRUK on stand-ins: each ends at the place of its sheet, in the tracking frame.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Unity.Mruk;
using Meta.XR.MRUtilityKit;
using NUnit.Framework;
using Standins;
using UnityEngine;

namespace IrisSession.Unity.StandinTests
{
    [TestFixture]
    public sealed class MrukTests
    {
        /// <summary>Where the code is in its plane: not at the origin of the trackable.</summary>
        private static readonly Vector2 Center = new Vector2(0.03f, -0.02f);
        private const float Edge = 0.15f;
        private readonly List<MarkerReport> reports = new List<MarkerReport>();
        private MRUK mruk;

        [SetUp]
        public void Begin()
        {
            Engine.Reset();
            mruk = new GameObject("mruk").AddComponent<MRUK>();
        }

        [TestCase(true)]
        [TestCase(false)]
        public void CodesAreConvertedToTheirSheets(bool hasRig)
        {
            Transform rig = new GameObject("rig").transform;
            rig.SetPositionAndRotation(new Vector3(0.4f, -0.2f, 1.3f), Quaternion.AngleAxis(70f, Vector3.up));
            MrukMarkers source = new MrukMarkers(mruk, hasRig ? rig : null);
            Vector3[] positions = { new Vector3(0.2f, 1.1f, 1f), new Vector3(-0.5f, 0.8f, 0.7f), new Vector3(0.9f, 0.3f, -0.2f) };
            Quaternion[] rotations =
            {
                Quaternion.AngleAxis(180f, Vector3.up), // on a wall ahead: +Z back to the viewer
                Quaternion.AngleAxis(35f, Vector3.up) * Quaternion.AngleAxis(-90f, Vector3.right), // flat on a table, turned
                Quaternion.AngleAxis(63f, new Vector3(0.48f, -0.8f, 0.36f)), // on a slope
            };
            for (int i = 0; i < positions.Length; i++)
            {
                Vector3 at = hasRig ? rig.TransformPoint(positions[i]) : positions[i];
                Make("sheet " + i).transform.SetPositionAndRotation(at, hasRig ? rig.rotation * rotations[i] : rotations[i]);
            }
            Assert.AreEqual(3, source.Read(reports));
            for (int i = 0; i < positions.Length; i++)
            {
                RigidTransform sheet = reports[i].Pose.T_tracking_anchor;
                Assert.AreEqual("sheet " + i, reports[i].Text);
                Assert.AreEqual(Edge, reports[i].Pose.SizeM, 1e-6);
                AssertNear(positions[i] + rotations[i] * new Vector3(Center.x, Center.y, 0f), sheet.Position);
                AssertNear(-(rotations[i] * Vector3.right), sheet.Rotation.Rotate(new Double3(1, 0, 0)));
                AssertNear(rotations[i] * Vector3.up, sheet.Rotation.Rotate(new Double3(0, 1, 0)));
                AssertNear(rotations[i] * Vector3.forward, sheet.Rotation.Rotate(new Double3(0, 0, 1)));
            }
        }

        [Test]
        public void OnlyCodesThatAreThereAreReported()
        {
            MrukMarkers source = new MrukMarkers(mruk, null);
            MRUKTrackable keyboard = Make("");
            keyboard.TrackableType = OVRAnchor.TrackableType.Keyboard;
            MRUKTrackable code = Make(null);
            source.Read(reports);
            Assert.AreEqual("", reports[0].Text, "not decoded yet");
            code.Payload = "table";
            code.IsTracked = false;
            for (int i = 0; i < 20; i++) source.Read(reports);
            Assert.AreEqual(1, reports.Count);
            Assert.AreEqual("table", reports[0].Text);
            Assert.IsFalse(reports[0].IsTracked);
            Assert.AreEqual(2, code.Reads, "the text of a code does not change");
            Assert.AreEqual(-1, reports[0].SeenNs);
            string id = reports[0].Id;
            code.PlaneRect = null;
            source.Read(reports);
            Assert.AreEqual(0, reports[0].Pose.SizeM);
            Object.Destroy(code.gameObject);
            Engine.Step();
            Make("table");
            source.Read(reports);
            Assert.AreNotEqual(id, reports[0].Id);
        }

        [Test]
        public void TheOriginIsOursAndCodesAreSearchedWhileTheyAreWanted()
        {
            mruk.SceneSettings.TrackerConfiguration = new OVRAnchor.TrackerConfiguration { KeyboardTrackingEnabled = true };
            MrukMarkers source = new MrukMarkers(mruk, null) { IsAllowed = false };
            Assert.IsFalse(mruk.EnableWorldLock);
            Assert.AreEqual(MarkerSupport.NotAllowed, source.Support);
            source.SetActive(true);
            Assert.IsFalse(mruk.SceneSettings.TrackerConfiguration.QRCodeTrackingEnabled);
            source.IsAllowed = true;
            source.SetActive(true);
            Assert.IsTrue(mruk.SceneSettings.TrackerConfiguration.QRCodeTrackingEnabled);
            Assert.IsTrue(mruk.SceneSettings.TrackerConfiguration.KeyboardTrackingEnabled, "of the application");
            source.SetActive(false);
            Assert.IsFalse(mruk.SceneSettings.TrackerConfiguration.QRCodeTrackingEnabled);
            mruk.QRCodeTrackingSupported = false;
            Assert.AreEqual(MarkerSupport.Missing, source.Support);
            Assert.AreEqual(MarkerSupport.Missing, new MrukMarkers(null, null).Support);
        }

        private MRUKTrackable Make(string payload)
        {
            MRUKTrackable made = new GameObject("trackable").AddComponent<MRUKTrackable>();
            made.Payload = payload;
            made.PlaneRect = new Rect(Center.x - 0.5f * Edge, Center.y - 0.5f * Edge, Edge, Edge);
            mruk.All.Add(made);
            return made;
        }

        /// <summary>Compare a point or direction of the engine with one of the wire: x ahead, y left, z up.</summary>
        private static void AssertNear(Vector3 engine, Double3 wire)
        {
            Assert.LessOrEqual((new Double3(engine.z, -engine.x, engine.y) - wire).Length, 1e-5, wire.ToString());
        }
    }
}
