using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Messages that are answered by a reply.</summary>
    internal static class RequestIds
    {
        /// <summary>Set the number of a request.</summary>
        /// <exception cref="InvalidMessageException">The message is none: use `Send`.</exception>
        public static void Set(ClientMessage message, long requestId)
        {
            switch (message)
            {
                case GetSnapshot one:
                    one.RequestId = requestId;
                    break;
                case Acquire one:
                    one.RequestId = requestId;
                    break;
                case Release one:
                    one.RequestId = requestId;
                    break;
                case Withdraw one:
                    one.RequestId = requestId;
                    break;
                case Consent one:
                    one.RequestId = requestId;
                    break;
                case Assign one:
                    one.RequestId = requestId;
                    break;
                case SetMode one:
                    one.RequestId = requestId;
                    break;
                case SetScale one:
                    one.RequestId = requestId;
                    break;
                case Grasp one:
                    one.RequestId = requestId;
                    break;
                case PlaceAlignment one:
                    one.RequestId = requestId;
                    break;
                case Align one:
                    one.RequestId = requestId;
                    break;
                case MoveAnchor one:
                    one.RequestId = requestId;
                    break;
                case Episode one:
                    one.RequestId = requestId;
                    break;
                case ClearEStop one:
                    one.RequestId = requestId;
                    break;
                case Control one:
                    one.RequestId = requestId;
                    break;
                case Marker one:
                    one.RequestId = requestId;
                    break;
                case RemoveParticipant one:
                    one.RequestId = requestId;
                    break;
                case Rename one:
                    one.RequestId = requestId;
                    break;
                case SetRole one:
                    one.RequestId = requestId;
                    break;
                default:
                    throw new InvalidMessageException(message.Tag + " is not a request: use Send");
            }
        }
    }
}
