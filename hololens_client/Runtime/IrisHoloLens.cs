// The component that makes a HoloLens 2 a headset of a session: beside IrisApp, on the camera offset of an XR origin.
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Protocol;
using IrisSession.Unity.App;
using IrisSession.Unity.Input;
using Microsoft.MixedReality.OpenXR;
using Unity.XR.CoreUtils;
using UnityEngine;

namespace IrisSession.HoloLens
{
    /// <summary>Hands with air taps, gaze, QR sheets, and commands above the left hand.</summary>
    [RequireComponent(typeof(IrisApp))]
    public sealed class IrisHoloLens : MonoBehaviour, IHeadsetKind
    {
        [SerializeField] private XROrigin origin = null;
        [SerializeField] private ARMarkerManager markerManager = null;

        public string[] Devices { get { return new[] { Device.Head, Device.HandLeft, Device.HandRight, Device.Gaze }; } }

        public DrawBudget Draws { get { return DrawBudget.HoloLens2; } }

        public void Prepare(IrisHeadset headset)
        {
            headset.Controls = ControlNames.HoloLensHands;
            headset.ControlsKind = InputKind.Hand;
            headset.Taps = new AirTap();
            if (origin != null) headset.MarkerSource = new HoloLensMarkers(origin, markerManager, transform);
        }

        /// <summary>There are no buttons: what they do elsewhere is commands.</summary>
        public void OnConnected(IrisHeadset headset)
        {
            HeadsetInput input = headset.Input;
            input.Buttons.NeedsGlance = false;
            input.Buttons.AddCommand(new Command("STOP all robots", () => input.StopAll("button of a HoloLens")));
            input.Buttons.AddCommand(new Command("Episode: begin, end", () => input.PressEpisode(true)));
            input.Buttons.AddCommand(new Command("Episode: discard", () => input.PressEpisode(false)));
        }

        /// <summary>Set what the inspector sets otherwise.</summary>
        public void SetUp(XROrigin origin, ARMarkerManager markerManager)
        {
            this.origin = origin;
            this.markerManager = markerManager;
        }
    }
}
