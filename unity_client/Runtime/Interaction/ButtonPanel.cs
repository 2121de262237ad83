// Buttons before the eyes: the answers to a question of consent, and the application's own commands on the back of the left hand
// (or above the left controller). Where they are, and which one a ray points at; all in the tracking frame. As
// web_client/src/xr/question.ts and consents.ts.
using System;
using System.Collections.Generic;
using IrisSession.Core;

namespace IrisSession.Interaction
{
    /// <summary>A button as it is drawn.</summary>
    public struct ShownButton
    {
        public Button Button;
        public string Text;
        public Double3 At;

        /// <summary>A ray points at it.</summary>
        public bool IsAimed;
    }

    /// <summary>A command of the application: a lab's own action, such as "next object".</summary>
    public sealed class Command
    {
        public readonly string Text;
        public readonly Action Run;

        public Command(string text, Action run)
        {
            Text = text;
            Run = run;
        }
    }

    /// <summary>Places buttons and finds those that are pointed at. For one thread.</summary>
    public sealed class ButtonPanel
    {
        /// <summary>Commands at most: a column that is still reached by a ray.</summary>
        public const int MaxCommands = 8;

        /// <summary>As large as a ball of this radius [m].</summary>
        public const double RadiusM = 0.055;
        private const double CommandRadiusM = 0.025;

        /// <summary>Distance of a question from the eyes [m], and angle above the middle of the view [rad]: robots that are looked at stay free.</summary>
        private const double DistanceM = 0.8;
        private const double Above = 0.26;
        private const double BelowM = 0.06;
        private const double BesideM = 0.11;

        /// <summary>Answers appear this long after the question: a press that was meant for a robot is no answer.</summary>
        private const long ReadNs = 700_000_000;

        /// <summary>Commands stand above the left hand, this far apart [m]; shown while its palm, or the face of the controller, looks at the eyes.</summary>
        private const double FirstM = 0.10;
        private const double ApartM = 0.055;
        private const double MinCosFacing = 0.5;

        private readonly List<Command> commands = new List<Command>();
        private readonly List<ShownButton> shown = new List<ShownButton>();
        private readonly BeforeEyes place = new BeforeEyes(DistanceM, Above);
        private long questionId = -1;

        /// <summary>Commands are shown only while the back of the left hand looks at the eyes; else whenever that hand is tracked.</summary>
        public bool NeedsGlance { get; set; } = true;

        /// <summary>Where a question is shown, in the tracking frame.</summary>
        public Double3 QuestionAt { get { return place.At; } }

        public bool HasQuestion { get { return place.IsPlaced; } }

        /// <summary>The buttons of the newest frame.</summary>
        public IReadOnlyList<ShownButton> Shown { get { return shown; } }

        public IReadOnlyList<Command> Commands { get { return commands; } }

        /// <summary>Add a command. Of more than eight none is shown.</summary>
        /// <exception cref="InvalidOperationException">There are eight.</exception>
        public void AddCommand(Command command)
        {
            if (commands.Count >= MaxCommands) throw new InvalidOperationException("a panel has " + MaxCommands + " commands at most");
            commands.Add(command);
        }

        public void RemoveCommand(Command command)
        {
            commands.Remove(command);
        }

        /// <summary>Place buttons for a frame.</summary>
        /// <param name="reading">The frame.</param>
        /// <param name="consentId">The question of consent that waits for an answer, -1 for none.</param>
        /// <param name="hasText">Something is to be said where questions are, such as one's own request that waits.</param>
        public void Update(HeadsetReading reading, long consentId, bool hasText)
        {
            if (consentId != questionId || (consentId < 0 && !hasText)) place.Hide();
            questionId = consentId;
            if (consentId >= 0 || hasText) place.Update(reading);
            shown.Clear();
            if (place.IsPlaced && consentId >= 0 && reading.CaptureNs - place.SinceNs >= ReadNs)
            {
                Double3 below = place.At - BelowM * place.Up;
                shown.Add(new ShownButton { Button = new Button(Button.Grant), Text = "Give it", At = below + BesideM * place.Left });
                shown.Add(new ShownButton { Button = new Button(Button.Refuse), Text = "Keep it", At = below - BesideM * place.Left });
            }
            ShowCommands(reading);
        }

        /// <summary>Return the button that a ray points at, and how far away it is [m].</summary>
        public Button FindAimed(AimRay ray, out double distanceM)
        {
            Button best = default;
            distanceM = double.MaxValue;
            for (int i = 0; i < shown.Count; i++)
            {
                ShownButton one = shown[i];
                double distance = Pointing.FindBall(ray, one.At, one.Button.Id >= Button.FirstCommand ? CommandRadiusM : RadiusM);
                if (distance < 0 || distance >= distanceM) continue;
                best = one.Button;
                distanceM = distance;
            }
            return best;
        }

        /// <summary>Mark a button as one that is pointed at.</summary>
        public void MarkAimed(Button button)
        {
            for (int i = 0; i < shown.Count; i++)
            {
                if (!shown[i].Button.Equals(button)) continue;
                ShownButton one = shown[i];
                one.IsAimed = true;
                shown[i] = one;
            }
        }

        /// <summary>Return the command of a button, null for another button or one that is gone.</summary>
        public Command FindCommand(Button button)
        {
            int number = button.Id - Button.FirstCommand;
            return number >= 0 && number < commands.Count ? commands[number] : null;
        }

        private void ShowCommands(HeadsetReading reading)
        {
            InputReading left = reading[Side.Left];
            if (commands.Count == 0 || !left.IsTracked || !reading.HasHead) return;
            Double3 line = reading.Head.Position - left.Pose.Position;
            Double3 up = left.Pose.Rotation.Rotate(new Double3(0, 0, 1));
            if (NeedsGlance && Double3.Dot(up, line) < MinCosFacing * line.Length) return;
            for (int i = 0; i < commands.Count; i++)
            {
                Double3 at = left.Pose.Position + new Double3(0, 0, FirstM + (commands.Count - 1 - i) * ApartM);
                shown.Add(new ShownButton { Button = new Button(Button.FirstCommand + i), Text = commands[i].Text, At = at });
            }
        }
    }
}
