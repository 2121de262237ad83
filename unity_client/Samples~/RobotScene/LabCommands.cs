// A command of your own above the left hand, and what the session says. Add this component to the object of IrisHeadset: 'Camera Offset'.
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Protocol;
using IrisSession.Transport;
using IrisSession.Unity.Input;
using UnityEngine;
using Event = IrisSession.Protocol.Event; // the engine has an Event, too

namespace IrisSession.Samples.RobotScene
{
    /// <summary>Counts trials, and shows for a few seconds what others do.</summary>
    [RequireComponent(typeof(IrisHeadset))]
    public sealed class LabCommands : MonoBehaviour
    {
        private const float ShownS = 5f;

        private IrisHeadset headset;
        private HeadsetInput input;
        private Command nextTrial;
        private int trials;
        private float leftS;

        private void Awake()
        {
            headset = GetComponent<IrisHeadset>();
            headset.News += Take;
            nextTrial = new Command("Trial: next", StartTrial);
        }

        private void OnDestroy() { headset.News -= Take; }

        private void Update()
        {
            if (headset.Input != input)
            {
                input = headset.Input; // another one for each session, null without one
                input?.Buttons.AddCommand(nextTrial);
            }
            if (leftS > 0f && (leftS -= Time.deltaTime) <= 0f) headset.Notice = "";
        }

        /// <summary>Runs when the wearer points at the command and presses the trigger.</summary>
        private void StartTrial() { Show("Trial " + ++trials); }

        /// <summary>Runs on the engine's thread, after the headset has taken the news itself.</summary>
        private void Take(SessionNews news)
        {
            if (news.Kind != NewsKind.Message || !(news.Message.Message is Event one)) return;
            if (one.Body is Handover) Show("Handed over in trial " + trials);
            else if (one.Body is ParticipantJoined joined) Show(joined.Participant.Name + " joined");
        }

        private void Show(string text)
        {
            headset.Notice = text;
            leftS = ShownS;
        }
    }
}
