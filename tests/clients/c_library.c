/* The C library that autopilots and ground stations use, in the hands of a test.
 *
 *     c_library KEY read            frames from standard input: the verdict on each, and its clock
 *     c_library KEY write LINK T N  N signed heartbeats of 7/9 to standard output, from time T on
 */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "minimal/mavlink.h"

static mavlink_signing_t signing;
static mavlink_signing_streams_t streams;

int main(int count, char **given)
{
    for (int i = 0; i < 32; i++) {
        sscanf(given[1] + 2 * i, "%2hhx", &signing.secret_key[i]);
    }
    signing.flags = MAVLINK_SIGNING_FLAG_SIGN_OUTGOING;
    mavlink_status_t *status = mavlink_get_channel_status(MAVLINK_COMM_0);
    status->signing = &signing;
    status->signing_streams = &streams;
    mavlink_message_t message;

    if (strcmp(given[2], "read") == 0) {
        mavlink_status_t parsed;
        for (int byte = getchar(); byte != EOF; byte = getchar()) {
            uint8_t verdict = mavlink_frame_char(MAVLINK_COMM_0, byte, &message, &parsed);
            if (verdict != MAVLINK_FRAMING_INCOMPLETE) {
                printf("%d %llu\n", verdict, (unsigned long long)signing.timestamp);
            }
        }
    } else if (count == 6) {
        signing.link_id = atoi(given[3]);
        signing.timestamp = strtoull(given[4], NULL, 10);
        for (int i = 0; i < atoi(given[5]); i++) {
            uint8_t buffer[MAVLINK_MAX_PACKET_LEN];
            mavlink_msg_heartbeat_pack_chan(7, 9, MAVLINK_COMM_0, &message, 2, 3, 0, i, 4);
            fwrite(buffer, 1, mavlink_msg_to_send_buffer(buffer, &message), stdout);
        }
    }
    return 0;
}
