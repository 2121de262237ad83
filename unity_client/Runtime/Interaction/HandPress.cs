// What one hand presses while marks are touched. Other meanings of the same buttons are in HandInput.cs.
using IrisSession.Core;

namespace IrisSession.Interaction
{
    /// <summary>Presses of one hand. Those that are held when the hand appears are none.</summary>
    public sealed class HandPress
    {
        /// <summary>A trigger held this long at nothing begins a new alignment [ns].</summary>
        public const long HoldNs = 2_000_000_000;

        // A value is pressed from the first on, and until it falls below the second.
        private const double Press = 0.6;
        private const double LetGo = 0.4;
        private const long Never = long.MinValue;

        private bool isKnown;
        private InputKind kind;
        private long buttons;
        private long heldNs = Never; // since when the trigger is held at nothing

        /// <summary>Held now.</summary>
        public bool Trigger { get; private set; }
        public bool Squeeze { get; private set; }

        /// <summary>Pressed in this frame.</summary>
        public bool IsTriggerPress { get; private set; }

        /// <summary>Of a controller: the fist of a hand is none.</summary>
        public bool IsSqueezePress { get; private set; }
        public long PressedButtons { get; private set; }

        /// <summary>Forget what is held.</summary>
        public void Forget()
        {
            isKnown = Trigger = Squeeze = IsTriggerPress = IsSqueezePress = false;
            PressedButtons = 0;
            heldNs = Never;
        }

        /// <summary>Take a frame. `isBusy`: the trigger means something else; `canBegin`: holding it begins an alignment.</summary>
        public void Read(InputReading input, bool isBusy, bool canBegin, long nowNs)
        {
            bool isNew = !isKnown || kind != input.Kind;
            if (!input.IsTracked) Forget();
            if (!input.IsTracked) return;
            bool hadTrigger = isNew || Trigger;
            bool hadSqueeze = isNew || Squeeze;
            Trigger = IsPressed(input.Trigger, hadTrigger);
            Squeeze = IsPressed(input.Squeeze, hadSqueeze);
            IsTriggerPress = Trigger && !hadTrigger && !isBusy;
            IsSqueezePress = Squeeze && !hadSqueeze && input.Kind == InputKind.Controller;
            PressedButtons = isNew ? 0 : input.Buttons & ~buttons;
            isKnown = true;
            kind = input.Kind;
            buttons = input.Buttons;
            if (!Trigger || Squeeze || isBusy || isNew || !canBegin || kind == InputKind.Hand) heldNs = Never;
            else if (IsTriggerPress) heldNs = nowNs;
        }

        /// <summary>Return, once, whether the trigger of a controller has been held long enough to begin.</summary>
        public bool TakeHold(long nowNs)
        {
            if (heldNs == Never || nowNs - heldNs < HoldNs) return false;
            heldNs = Never;
            return true;
        }

        private static bool IsPressed(double value, bool before)
        {
            return before ? value > LetGo : value >= Press;
        }
    }
}
