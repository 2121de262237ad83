// The permission without which Quest shows no codes.
using System;
using UnityEngine.Android;

namespace IrisSession.Unity.Input
{
    /// <summary>Asks the wearer once, and says what they have answered. On other systems it is not needed: do not make one there.</summary>
    public sealed class ScenePermission
    {
        /// <summary>What Horizon OS calls it: codes, planes and meshes of the room.</summary>
        public const string UseScene = "com.oculus.permission.USE_SCENE";

        private readonly Action<bool> answered;
        private bool isAsked;
        private bool? known;

        /// <param name="answered">Called when the answer is there or changes, on the thread of <see cref="Poll"/>.</param>
        public ScenePermission(Action<bool> answered)
        {
            this.answered = answered;
        }

        public bool IsAllowed { get { return known == true; } }

        /// <summary>Ask if that was not done, and look at the answer: once a second. The wearer may change it in the settings at any time.</summary>
        public void Poll()
        {
            bool isAllowed = Permission.HasUserAuthorizedPermission(UseScene);
            if (isAllowed == known) return;
            if (!isAllowed && !isAsked)
            {
                isAsked = true;
                Permission.RequestUserPermission(UseScene); // its callbacks come on another thread: the next poll sees the answer
                return;
            }
            known = isAllowed;
            answered(isAllowed);
        }
    }
}
