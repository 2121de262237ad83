// Draw calls of a frame, and what they are for.
namespace IrisSession.Core
{
    /// <summary>What a headset can draw at its rate. Immutable.</summary>
    public sealed class DrawBudget
    {
        /// <summary>Quest 3: the rest is for clouds and panels.</summary>
        public static readonly DrawBudget Quest3 = new DrawBudget(200, SceneBudget.Quest3.WithObjects(150), AvatarTable.MaxAvatars, 12, MediaStreams.MaxStreams, true);

        /// <summary>HoloLens 2 at 60 Hz: panels and rays have 26 calls, avatars are those of two people, clouds of two cameras.</summary>
        public static readonly DrawBudget HoloLens2 = new DrawBudget(50, SceneBudget.HoloLens2.WithObjects(16), 6, 6, 2, false);

        /// <summary>Draw calls of a frame.</summary>
        public readonly int Calls;

        /// <summary>Within which the plan of a scene is made.</summary>
        public readonly SceneBudget Scene;

        /// <summary>Heads and hands of others.</summary>
        public readonly int Avatars;

        /// <summary>Panels of robots.</summary>
        public readonly int RobotPanels;

        /// <summary>Clouds that are drawn.</summary>
        public readonly int Clouds;

        /// <summary>Ghosts of the hands that the wearer drives are drawn.</summary>
        public readonly bool HasGhosts;

        public DrawBudget(int calls, SceneBudget scene, int avatars, int robotPanels, int clouds, bool hasGhosts)
        {
            Calls = calls;
            Scene = scene;
            Avatars = avatars;
            RobotPanels = robotPanels;
            Clouds = clouds;
            HasGhosts = hasGhosts;
        }
    }
}
