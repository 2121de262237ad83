using IrisSession.Core;
using IrisSession.Unity.Input;

namespace IrisSession.Unity.App
{
    /// <summary>What differs between headsets: a component beside <see cref="IrisApp"/>. Without one there are head and controllers, no codes.</summary>
    public interface IHeadsetKind
    {
        /// <summary>Devices that a hello declares (`Device`).</summary>
        string[] Devices { get; }

        DrawBudget Draws { get; }

        /// <summary>Set the devices of a headset: once, before its first frame.</summary>
        void Prepare(IrisHeadset headset);

        /// <summary>A session was joined; `headset.Input` is there.</summary>
        void OnConnected(IrisHeadset headset);
    }
}
