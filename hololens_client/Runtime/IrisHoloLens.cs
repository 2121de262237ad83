// The component that makes a HoloLens 2 a headset of a session: on the camera offset of an XR origin, with IrisHeadset and IrisWorld.
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Protocol;
using IrisSession.Transport;
using IrisSession.Unity;
using IrisSession.Unity.Input;
using Unity.XR.CoreUtils;
using UnityEngine;

namespace IrisSession.HoloLens
{
    /// <summary>Hands with air taps, gaze, QR sheets, and commands above the left hand.</summary>
    [RequireComponent(typeof(IrisHeadset))]
    [RequireComponent(typeof(IrisWorld))]
    public sealed class IrisHoloLens : MonoBehaviour
    {
        /// <summary>Draw calls of a frame within which HoloLens 2 keeps 60 Hz, and how many are for the scene: others are avatars and panels.</summary>
        public const int DrawCalls = 50;
        public const int SceneDrawCalls = 20;

        [SerializeField] private XROrigin origin = null;
        [SerializeField] private Behaviour markerManager = null;
        private IrisHeadset headset;

        /// <summary>The devices that a hello of this headset declares.</summary>
        public static string[] Devices { get { return new[] { Device.Head, Device.HandLeft, Device.HandRight, Device.Gaze }; } }

        /// <summary>What a scene may have of a HoloLens 2.</summary>
        public static SceneBudget PlanBudget { get { return SceneBudget.HoloLens2.WithObjects(SceneDrawCalls); } }

        /// <summary>Join what `client` connects to. Its hello has <see cref="Devices"/>, its scene is planned within <see cref="PlanBudget"/>.</summary>
        public void Connect(SessionClient client)
        {
            headset = GetComponent<IrisHeadset>();
            headset.Controls = ControlNames.HoloLensHands;
            headset.ControlsKind = InputKind.Hand;
            headset.Taps = new AirTap();
            headset.MarkerSource = new HoloLensMarkers(origin, markerManager, transform);
            headset.Connect(client, new WorldBodies(GetComponent<IrisWorld>()));
            if (headset.Input == null) return;
            // There are no buttons: what they do elsewhere is commands.
            headset.Input.Buttons.NeedsGlance = false;
            headset.Input.Buttons.AddCommand(new Command("STOP all robots", () => client.EStop("button of a HoloLens")));
            headset.Input.Buttons.AddCommand(new Command("Episode: begin, end", () => headset.Input.PressEpisode(true)));
            headset.Input.Buttons.AddCommand(new Command("Episode: discard", () => headset.Input.PressEpisode(false)));
        }

        /// <summary>Set what the inspector sets otherwise.</summary>
        public void SetUp(XROrigin origin, Behaviour markerManager)
        {
            this.origin = origin;
            this.markerManager = markerManager;
        }
    }
}
