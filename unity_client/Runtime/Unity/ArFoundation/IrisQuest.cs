// The component that makes a Quest 3, or another OpenXR headset with AR Foundation, a headset of a session: beside IrisApp.
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Unity.App;
using IrisSession.Unity.Input;
using Unity.XR.CoreUtils;
using UnityEngine;
using UnityEngine.XR.ARFoundation;

namespace IrisSession.Unity.ArFoundation
{
    /// <summary>Controllers, bare hands, QR sheets, and the view of the room.</summary>
    [RequireComponent(typeof(IrisApp))]
    public sealed class IrisQuest : MonoBehaviour, IHeadsetKind
    {
        private const double PollS = 1.0;

        [SerializeField] private XROrigin origin = null;
        [SerializeField] private ARMarkerManager markerManager = null;
        [SerializeField] private Behaviour cameraManager = null;
        private IrisHeadset headset;
        private ArMarkers markers;
        private ScenePermission permission;
        private double pollAt;

        /// <summary>The view of the room, on from the start.</summary>
        public ArPassthrough Passthrough { get; private set; }

        public string[] Devices { get { return new[] { Device.Head, Device.ControllerLeft, Device.ControllerRight, Device.HandLeft, Device.HandRight }; } }

        public DrawBudget Draws { get { return DrawBudget.Quest3; } }

        public void Prepare(IrisHeadset headset)
        {
            this.headset = headset;
            headset.BareHands = new XrHands();
            Passthrough = new ArPassthrough(cameraManager) { IsOn = true };
            if (origin == null) return;
            markers = new ArMarkers(origin, markerManager, transform);
            headset.MarkerSource = markers;
            if (markerManager == null || Application.platform != RuntimePlatform.Android) return;
            markers.IsAllowed = false;
            permission = new ScenePermission(TakeAnswer);
        }

        public void OnConnected(IrisHeadset headset)
        {
        }

        /// <summary>Set what the inspector sets otherwise.</summary>
        public void SetUp(XROrigin origin, ARMarkerManager markerManager, Behaviour cameraManager)
        {
            this.origin = origin;
            this.markerManager = markerManager;
            this.cameraManager = cameraManager;
        }

        private void Update()
        {
            if (permission == null || Time.realtimeSinceStartupAsDouble < pollAt) return;
            pollAt = Time.realtimeSinceStartupAsDouble + PollS;
            permission.Poll();
        }

        private void TakeAnswer(bool isAllowed)
        {
            markers.IsAllowed = isAllowed;
            headset.SetPermission(HeadsetPermission.Scene, isAllowed);
        }
    }
}
