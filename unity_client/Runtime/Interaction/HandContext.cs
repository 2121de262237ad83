// What hands are judged by at a frame, and what they ask for.
using System;
using System.Collections.Generic;

namespace IrisSession.Interaction
{
    /// <summary>What a hand can point at and press that is no robot: an answer, or a button.</summary>
    public readonly struct Button : IEquatable<Button>
    {
        /// <summary>Nothing.</summary>
        public const int None = 0;
        public const int Grant = 1;
        public const int Refuse = 2;

        /// <summary>The first of the application's own commands.</summary>
        public const int FirstCommand = 16;

        public readonly int Id;

        public Button(int id)
        {
            Id = id;
        }

        public bool IsSomething { get { return Id != None; } }

        public bool Equals(Button other) { return Id == other.Id; }

        public override bool Equals(object other) { return other is Button value && Equals(value); }

        public override int GetHashCode() { return Id; }
    }

    public enum IntentKind
    {
        Acquire,
        Release,
        Press,

        /// <summary>Stay where the scene is shown.</summary>
        Place,
    }

    /// <summary>What a hand asks for.</summary>
    public readonly struct HandIntent
    {
        public readonly IntentKind Kind;
        public readonly string Robot;
        public readonly Button Button;

        public HandIntent(IntentKind kind, string robot = "", Button button = default)
        {
            Kind = kind;
            Robot = robot;
            Button = button;
        }
    }

    /// <summary>What the session and the picture say at a frame. Made once and filled again.</summary>
    public sealed class HandContext
    {
        /// <summary>Robots that this participant holds.</summary>
        public readonly List<string> Held = new List<string>();

        /// <summary>Of each one that no other participant holds, too.</summary>
        public readonly Dictionary<string, Tenure> Tenures = new Dictionary<string, Tenure>();

        /// <summary>Robots that the session moves for this participant.</summary>
        public readonly List<string> Following = new List<string>();

        /// <summary>Robots that hold because the pose of their device is an estimate.</summary>
        public readonly List<string> Guessed = new List<string>();

        /// <summary>The robot that each hand points at, empty for none.</summary>
        public readonly string[] Pointed = { "", "" };

        /// <summary>The button that each hand points at; it is nearer than robots.</summary>
        public readonly Button[] Aimed = new Button[2];

        /// <summary>This participant may place itself, and is not aligned.</summary>
        public bool CanPlace;

        /// <summary>Marks are touched: squeezes and the lower and upper buttons mean that, and triggers at no button.</summary>
        public bool IsTouching;

        public void Clear()
        {
            Held.Clear();
            Tenures.Clear();
            Following.Clear();
            Guessed.Clear();
            for (int side = 0; side < 2; side++)
            {
                Pointed[side] = "";
                Aimed[side] = default;
            }
            CanPlace = IsTouching = false;
        }
    }
}
